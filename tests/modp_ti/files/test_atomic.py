"""Files appear whole or not at all, whatever comes in between."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from modp_ti.files.atomic import replace_file, replace_text, replacing, written_aside
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
