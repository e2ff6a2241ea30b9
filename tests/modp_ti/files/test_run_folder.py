"""Files and folders appear whole or not at all, and nothing else in them is lost."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from modp_ti.config.scene_file import dump_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.files.atomic import replace_file, replace_text, replacing, written_aside
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import (
    PRIVATE,
    appearing,
    is_run_folder,
    refuse_foreign,
    require_usable,
    require_whole,
    run_folder,
    sole_use,
)
from tests.patience import PATIENCE

PROJECT = Path(__file__).resolve().parents[3]

FIRST = {"splats.ply": "1", "colmap/cameras.bin": "1", "colmap/old.bin": "1", "masks/000001.png": "1"}

SECOND = {"splats.ply": "2", "colmap/cameras.bin": "2", "trajectory.txt": "2", "metrics.json": "2"}

HOLDS = """
import sys, time; from pathlib import Path; from modp_ti.files.run_folder import sole_use
with sole_use(Path(sys.argv[1])):
    print("holds", flush=True); time.sleep(1000)
"""

# Writes files over those of a folder, and dies at the n-th rename or removal.
DIES = """
import json, os, sys; from pathlib import Path; from modp_ti.files.run_folder import appearing
left = int(sys.argv[2])
def counted(call):
    def step(*arguments, **options):
        global left
        left -= 1
        if left < 0: os.kill(os.getpid(), 9)
        return call(*arguments, **options)
    return step
os.replace, Path.unlink, os.unlink = counted(os.replace), counted(Path.unlink), counted(os.unlink)
with appearing(Path(sys.argv[1]), ("colmap", "masks")) as folder:
    for name, text in json.loads(sys.argv[3]).items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
"""


def fill(output: Path, files: dict[str, str], outdated: tuple[str, ...] = ()) -> None:
    with appearing(output, outdated) as folder:
        for name, text in files.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)


def files_of(folder: Path) -> dict[str, str]:
    return {
        file.relative_to(folder).as_posix(): file.read_text()
        for file in folder.rglob("*")
        if file.is_file() and PRIVATE not in file.parts
    }


def test_a_folder_has_the_old_files_or_the_new_ones_wherever_the_process_dies(tmp_path: Path) -> None:
    seen = []
    for steps in range(100):
        output = tmp_path / str(steps)
        fill(output, FIRST)
        (output / "notes.txt").write_text("mine")
        command = [sys.executable, "-c", DIES, str(output), str(steps), json.dumps(SECOND)]
        died = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True, timeout=PATIENCE, check=False)
        require_whole(output)  # as every reader asks
        found = files_of(output)
        assert found.pop("notes.txt") == "mine"
        assert found in (FIRST, SECOND)
        seen.append(found == SECOND)
        with run_folder(output):
            assert [file.name for file in (output / PRIVATE).iterdir()] == ["files.json"]
        if died.returncode == 0:
            break
        assert died.returncode == -9, died.stderr
    assert died.returncode == 0 and seen == sorted(seen) and sum(seen) > 5 < len(seen)


def test_what_cannot_be_written_whole_leaves_what_was_there(tmp_path: Path) -> None:
    fill(tmp_path / "out", FIRST)
    with pytest.raises(InputError) as refused, appearing(tmp_path / "out", ("colmap",)) as folder:
        (folder / "splats.ply").write_text("2")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert "\n" not in str(refused.value) and os.strerror(errno.ENOSPC) in str(refused.value)
    assert files_of(tmp_path / "out") == FIRST
    assert os.listdir(tmp_path) == ["out"]


@pytest.mark.parametrize("name", ["splats.ply", "colmap", "colmap/cameras.bin", "masks/000009.png", PRIVATE])
@pytest.mark.parametrize("kind", ["file", "link", "folder"])
def test_what_no_run_has_written_stays(tmp_path: Path, name: str, kind: str) -> None:
    elsewhere, output = tmp_path / "elsewhere", tmp_path / "out"
    shutil.copytree(_tree(elsewhere, {"cameras.bin": "mine", "files.json": "mine"}), output / "other")
    (output / name).parent.mkdir(exist_ok=True)
    if kind == "file":
        (output / name).write_text("mine")
    elif kind == "link":
        (output / name).symlink_to(elsewhere)
    else:
        shutil.copytree(elsewhere, output / name)
    before = files_of(tmp_path), sorted(os.listdir(output))
    for act in (lambda: require_usable(output), lambda: fill(output, SECOND | FIRST | {"masks/000009.png": ""})):
        with pytest.raises(InputError) as refused:
            act()
        assert "\n" not in str(refused.value) and str(output / name) in str(refused.value)
        assert (files_of(tmp_path), sorted(os.listdir(output))) == before


def _tree(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def test_files_next_to_those_of_a_run_stay(tmp_path: Path) -> None:
    output = tmp_path / "out"
    fill(output, FIRST)
    mine = {"notes.txt": "mine", "masks/.DS_Store": "", "images/a.png": "mine", "out.partial/a": "mine"}
    _tree(output, mine)
    _tree(tmp_path / "out.partial", {"a": "mine"})
    with run_folder(output):
        fill(output, SECOND, ("colmap", "masks"))
    assert files_of(output) == SECOND | mine
    assert files_of(tmp_path / "out.partial") == {"a": "mine"}


def test_a_folder_of_an_earlier_version_is_known_by_its_settings(tmp_path: Path) -> None:
    output = _tree(tmp_path / "out", FIRST | {"colmap/mine.db": "mine"})
    assert not is_run_folder(output)
    scene = {"source": {"path": "images"}, "tracker": {"kind": "klt"}, "output": "out"}
    dump_scene(SceneConfig.model_validate(scene), output / "config.yaml")
    assert is_run_folder(output)
    refuse_foreign(output, ["splats.ply", "masks"])
    with pytest.raises(InputError, match=r"mine\.db"):
        refuse_foreign(output, ["colmap"])


def test_a_run_that_leaves_nothing_leaves_no_folder(tmp_path: Path) -> None:
    with run_folder(tmp_path / "new" / "out"):
        assert (tmp_path / "new" / "out").is_dir()
    require_usable(tmp_path / "new" / "out")
    assert os.listdir(tmp_path) == []
    (tmp_path / "old").mkdir()
    with sole_use(tmp_path / "old"), run_folder(tmp_path / "old"):  # as a task of a batch does
        pass
    assert os.listdir(tmp_path) == ["old"]


@pytest.mark.parametrize("place", ["file", "file/out", "/proc/out", "/proc/self/out"])
def test_a_folder_that_cannot_be_written_is_refused_at_once(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").touch()
    for act in (require_usable, lambda output: run_folder(output).__enter__()):
        with pytest.raises(InputError) as refused:
            act(tmp_path / place)
        assert "\n" not in str(refused.value)
    assert os.listdir(tmp_path) == ["file"]


def test_a_second_process_is_refused_until_the_first_is_gone(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "folder"
    process = subprocess.Popen([sys.executable, "-c", HOLDS, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "holds\n"
    with pytest.raises(InputError, match="another process is at work there"), sole_use(folder, patience=0.2):
        pass
    os.kill(process.pid, signal.SIGKILL)
    with sole_use(folder, PATIENCE):
        assert list(folder.iterdir()) == []
    process.communicate()


def test_a_file_takes_the_place_of_the_one_before_only_when_it_is_whole(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    replace_text(target, "first é\n")
    with replacing(target, "w") as file:
        file.write("second\n")
        file.flush()
        assert target.read_bytes() == "first é\n".encode()
    assert target.read_bytes() == b"second\n"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_fault_in_the_midst_leaves_what_was_there_and_nothing_else(tmp_path: Path) -> None:
    target = tmp_path / "a.bin"
    replace_file(target, b"first")
    with pytest.raises(KeyboardInterrupt), replacing(target) as file:
        file.write(b"sec")
        raise KeyboardInterrupt
    assert target.read_bytes() == b"first"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_a_full_disk_leaves_what_was_there(tmp_path: Path) -> None:
    """A limit on a file's size stands for the disk: the system refuses what lies beyond it, in the midst of a write."""
    target = tmp_path / "a.bin"
    replace_file(target, b"first")
    code = (
        "import resource, signal, sys\n"
        "from modp_ti.files.atomic import replace_file\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try:\n    replace_file(sys.argv[1], bytes(5000))\nexcept OSError as error:\n    print(error.errno)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, str(target)],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
    )
    assert int(result.stdout) == errno.EFBIG
    assert target.read_bytes() == b"first"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_no_write_follows_a_symbolic_link_or_takes_a_file_of_another_name(tmp_path: Path) -> None:
    """Whatever names another user has laid out beside the file: links to a victim, or files."""
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    for name in ("a.bin", "a.bin.partial", ".a.bin.partial", "a.partial.bin"):
        (tmp_path / name).symlink_to(victim)
    before = set(os.listdir(tmp_path))
    replace_file(tmp_path / "a.bin", b"new")
    with written_aside(tmp_path / "a.bin") as partial:
        partial.write_bytes(b"newer")
    assert victim.read_bytes() == b"precious"
    assert (tmp_path / "a.bin").read_bytes() == b"newer" and not (tmp_path / "a.bin").is_symlink()
    assert set(os.listdir(tmp_path)) == before
