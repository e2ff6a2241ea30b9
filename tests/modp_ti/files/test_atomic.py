"""Files appear whole or not at all, whatever comes in between."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from modp_ti.files import atomic
from modp_ti.files.atomic import replace_file, replace_text, replacing, write_picture
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.map_folder import appearing
from tests.patience import PATIENCE

PROJECT = Path(__file__).resolve().parents[3]


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


def test_the_file_is_on_the_disk_before_it_takes_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    sync, move = os.fsync, os.replace

    def fsync(handle: int) -> None:
        done.append("folder" if os.path.isdir(f"/proc/self/fd/{handle}") else "file")
        sync(handle)

    def replace(a: Path, b: Path) -> None:
        done.append("replace")
        move(a, b)

    monkeypatch.setattr(atomic.os, "fsync", fsync)
    monkeypatch.setattr(atomic.os, "replace", replace)
    replace_file(tmp_path / "a", b"content")
    assert done == ["file", "replace", "folder"]


def test_a_picture_is_what_it_was(tmp_path: Path) -> None:
    import cv2

    image = np.random.default_rng(0).integers(0, 255, (7, 9, 3), dtype=np.uint8)
    write_picture(tmp_path / "a.png", image)
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png"))[..., ::-1], image)


def test_a_folder_that_cannot_be_filled_leaves_the_one_before(tmp_path: Path) -> None:
    output = tmp_path / "out"
    with appearing(output) as folder:
        replace_text(folder / "metrics.json", "{}")
        replace_text(folder / "map", "first")
    with (
        pytest.raises(InputError, match="out: cannot be written: No space left on device"),
        appearing(output) as folder,
    ):
        replace_text(folder / "map", "second")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert {file.name: file.read_text() for file in output.iterdir()} == {"map": "first", "metrics.json": "{}"}
    assert os.listdir(tmp_path) == ["out"]


def test_the_figures_come_last_so_that_a_folder_that_has_them_is_whole(tmp_path: Path, monkeypatch) -> None:
    from modp_ti.outputs.formats import map_folder

    moved: list[str] = []
    move = os.replace
    monkeypatch.setattr(map_folder.os, "replace", lambda a, b: (moved.append(Path(b).name), move(a, b)))
    with appearing(tmp_path / "out") as folder:
        for name in ("splats.ply", "metrics.json", "trajectory.txt"):
            (folder / name).write_text(name)
    assert moved == ["splats.ply", "trajectory.txt", "metrics.json"]
