"""A whole run on frames that another process sends."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.modp_ti.runs import SHORT_RUN, finished_run
from tests.patience import PATIENCE

ROOT = Path(__file__).parents[4]
LIVE = """
source:  {holdout: 4}
tracker: {kind: socket, path: server}
output:  out
"""
pytestmark = pytest.mark.slow


def test_a_run_on_sent_frames_gives_the_same_map_byte_for_byte(finished: Path, tmp_path: Path) -> None:
    # Poses and points come two frames after their images.
    command = [sys.executable, str(ROOT / "scripts" / "send_frames.py"), str(finished.parent / "scene.yaml")]
    options = ["--to", str(tmp_path / "server"), "--late", "2", "--wait", "300"]
    sender = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        settings = SHORT_RUN.partition("output:  out\n")[2].replace("mapping: {", "mapping: {pace: complete, ")
        sent = finished_run(tmp_path, LIVE + settings, "9 frames, ")
        assert sender.communicate(timeout=PATIENCE)[0] == "9 frames taken\n"
    finally:
        sender.kill()
    for name in ("splats.ply", "trajectory.txt"):
        assert (sent / name).read_bytes() == (finished / name).read_bytes()
    scores = [json.loads((folder / "metrics.json").read_text())["refined"] for folder in (finished, sent)]
    assert scores[0] == scores[1]
    assert not (tmp_path / "server").exists()
