"""A whole run whose tracker's process is killed: the map is saved."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.patience import PATIENCE

pytestmark = pytest.mark.slow

SCENE = """
source:  {path: images, realtime: true, fps: 8, scale: 0.25, holdout: 8, intrinsics: {fx: 270, fy: 270}}
tracker: {kind: klt}
output:  out
device:  cpu
mapping: {optimise: {steps: 1}}
refine:  {steps: 0}
export:  {report: false}
"""


@pytest.fixture
def run(box_walk, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A run of the walk at its own pace, with its temporary files in `temporary`."""
    box_walk.written(tmp_path / "images")
    (tmp_path / "scene.yaml").write_text(SCENE)
    (tmp_path / "temporary").mkdir()
    environment = {**os.environ, "TMPDIR": str(tmp_path / "temporary")}
    command = [sys.executable, "-m", "modp_ti.run", str(tmp_path / "scene.yaml")]
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True)
    yield process
    process.kill()
    process.communicate()


def tracker_of(run: subprocess.Popen[str]) -> int:
    """The id of the tracker's process."""
    children = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
    (child,) = [child for child in children if "tracking_process" in Path(f"/proc/{child}/cmdline").read_text()]
    return int(child)


def test_a_killed_tracker_ends_the_recording_and_the_map_is_saved(run, tmp_path):
    said = ""
    while "the tracker has a process of its own" not in said:  # which is said when the first frame is there
        line = run.stderr.readline()
        assert line, said
        said += line
    os.kill(tracker_of(run), signal.SIGKILL)
    said += run.communicate(timeout=PATIENCE)[1]
    assert run.returncode == 0, said
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    count = int(re.search(r"the tracker process ended \(signal 9\); the map is finished with\s+the (\d+)", said)[1])
    assert metrics["frames"] == count < 60
    assert metrics["online"]["held_out"]["count"] > 0
    assert list((tmp_path / "temporary").glob("modp-ti*")) == []
