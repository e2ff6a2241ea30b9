"""A whole run on frames that another process sends."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from tests.modp_ti.runs import finished_run

ROOT = Path(__file__).parents[4]
SCENE = """
source:  {source}
tracker: {tracker}
output:  out
device:  cpu
seed:    3
mapping: {{optimise: {{steps: 4, last_steps: 6}}, densify: {{warm_up: 3}}}}
refine:  {{steps: 5}}
"""


def test_a_run_on_sent_frames_gives_the_same_map_byte_for_byte(tmp_path: Path) -> None:
    scene = SCENE.format(source="{scale: 0.25, holdout: 4, stop: 7, fps: 10}", tracker="{kind: synthetic}")
    (tmp_path / "file").mkdir()
    (tmp_path / "socket").mkdir()
    read = finished_run(tmp_path / "file", scene, "7 frames, ")
    # Poses and points come two frames after their images.
    command = [sys.executable, str(ROOT / "scripts" / "send_frames.py"), str(tmp_path / "file" / "scene.yaml")]
    options = ["--to", str(tmp_path / "socket" / "door"), "--late", "2", "--wait", "300"]
    sender = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        live = SCENE.format(source="{holdout: 4}", tracker="{kind: socket, path: door}")
        sent = finished_run(tmp_path / "socket", live, "7 frames, ")
        assert sender.communicate(timeout=60)[0] == "7 frames taken\n"
    finally:
        sender.kill()
    for name in ("splats.ply", "trajectory.txt"):
        assert (sent / name).read_bytes() == (read / name).read_bytes()
    scores = [json.loads((folder / "metrics.json").read_text())["refined"] for folder in (read, sent)]
    assert scores[0] == scores[1]
    assert not (tmp_path / "socket" / "door").exists()
