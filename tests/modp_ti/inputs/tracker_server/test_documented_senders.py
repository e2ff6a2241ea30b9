"""Senders in other processes: those of docs/examples as written, and a whole run on what `send_frames` sends."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.engine.session import run_scene
from modp_ti.inputs.readers.socket import SocketSettings
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.inputs.tracker_server import TrackerServer
from tests.modp_ti.runs import SHORT_RUN
from tests.patience import PATIENCE

ROOT = Path(__file__).parents[4]
EXAMPLES = ROOT / "docs" / "examples"
LIVE = """
source:  {holdout: 4}
tracker: {kind: socket, path: server}
output:  out
"""


def received(command: list[str]) -> list:
    tracker = TrackerServer(SourceSettings(), SocketSettings(address="127.0.0.1:0"))
    try:
        port = tracker.address.rpartition(":")[2]
        sender = subprocess.run([*command, port], capture_output=True, text=True, timeout=PATIENCE, check=False)
        assert (sender.returncode, sender.stdout, sender.stderr) == (0, "10 frames taken\n", "")
        return list(tracker)
    finally:
        tracker.close()


def test_the_python_sender() -> None:
    frames = received([sys.executable, str(EXAMPLES / "sender.py")])
    assert len(frames) == 10
    for i, frame in enumerate(frames):
        assert frame.timestamp == i / 30
        T = frame.T_camera_world
        assert T[0, 3] == -0.05 * i
        p = frame.points.xyz + T[:3, 3]
        np.testing.assert_allclose(frame.camera.project(p), frame.points.pixels, atol=1e-9)
        column, row = frame.points.pixels.astype(int).T
        assert (frame.rgba[row, column, :3] == (250, 200, 100)).all()
        assert len(frame.points) > 100


def test_the_c_sender(tmp_path: Path) -> None:
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    program = str(tmp_path / "tracker")
    build = [compiler, "-std=c++17", "-Wall", "-Wextra", "-Werror", str(EXAMPLES / "sender.cpp"), "-o", program]
    subprocess.run(build, check=True, timeout=PATIENCE)
    frames = received([program])
    assert [int(f.rgba[3, 3, 0]) for f in frames] == [20 * i for i in range(10)]
    for i, frame in enumerate(frames):
        assert frame.timestamp == i / 30
        assert frame.points.ids.tolist() == [7]
        np.testing.assert_allclose(frame.camera.project(frame.points.xyz + frame.T_camera_world[:3, 3]), [[32, 24]])


@pytest.mark.slow
def test_a_run_on_sent_frames_gives_the_same_map_byte_for_byte(finished: Path, tmp_path: Path) -> None:
    # Poses and points come two frames after their images.
    command = [sys.executable, str(ROOT / "scripts" / "send_frames.py"), str(finished.parent / "scene.yaml")]
    options = ["--to", str(tmp_path / "server"), "--late", "2", "--wait", "300"]
    sender = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        settings = SHORT_RUN.partition("output:  out\n")[2].replace("mapping: {", "mapping: {pace: complete, ")
        (tmp_path / "scene.yaml").write_text(LIVE + settings)
        sent = run_scene(load_scene(tmp_path / "scene.yaml"))
        assert sender.communicate(timeout=PATIENCE)[0] == "9 frames taken\n"
    finally:
        sender.kill()
    for name in ("splats.ply", "trajectory.txt"):
        assert (sent / name).read_bytes() == (finished / name).read_bytes()
    scores = [json.loads((folder / "metrics.json").read_text())["refined"] for folder in (finished, sent)]
    assert scores[0] == scores[1]
    assert not (tmp_path / "server").exists()
