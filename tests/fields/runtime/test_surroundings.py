"""The engine runs without a home, leaves nothing behind there, and says early what a narrow address space lacks."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from fields.runtime.surroundings import NEEDED, why_too_narrow
from tests.patience import PATIENCE


@pytest.mark.slow
@pytest.mark.parametrize("home", [None, "a file", "/proc/none"])
def test_a_process_without_a_home_ends_well(tmp_path: Path, home: str | None) -> None:
    (tmp_path / "a file").touch()
    (tmp_path / "tmp").mkdir()
    environment = {**os.environ, "TMPDIR": str(tmp_path / "tmp"), "HOME": str(tmp_path / home) if home else ""}
    for name in ("XDG_CACHE_HOME", "MPLCONFIGDIR", *([] if home else ["HOME"])):
        environment.pop(name, None)
    program = "import modp_ti; print(modp_ti.initialise('cpu'))"
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "cpu\n", "")
    assert list((tmp_path / "tmp").iterdir()) == []


@pytest.mark.parametrize("limit", [1_500_000_000, NEEDED, resource.RLIM_INFINITY])
def test_a_narrow_address_space_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch, limit: int) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit, limit))
    why = why_too_narrow()
    assert (why is None) == (limit != 1_500_000_000)
    assert why is None or "\n" not in why
