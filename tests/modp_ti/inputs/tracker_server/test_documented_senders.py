"""The senders of docs/examples run as written, in processes of their own, and what they send is taken."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from modp_ti.config.settings import SourceSettings
from modp_ti.inputs.readers.socket import SocketSettings
from modp_ti.inputs.tracker_server import open_tracker_server
from tests.patience import PATIENCE

EXAMPLES = Path(__file__).parents[4] / "docs" / "examples"


def received(command: list[str]) -> list:
    tracker = open_tracker_server(SourceSettings(prefetch=16), SocketSettings(address="127.0.0.1:0"))
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
