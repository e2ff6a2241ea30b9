"""One process at a time works on a folder, and its end ends the lock."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from modp_ti.files.errors import InputError
from modp_ti.files.sole_use import sole_use
from tests.patience import PATIENCE

HOLDS = """
import sys, time; from pathlib import Path; from modp_ti.files.sole_use import sole_use
with sole_use(Path(sys.argv[1])):
    print("holds", flush=True); time.sleep(1000)
"""


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


def test_a_folder_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written: Not a directory"), sole_use(tmp_path / "file" / "a"):
        pass
