"""Runs that are ended by a signal: the map so far is there, and what was recorded or snapshotted goes on."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.fault_injection.recordings import write_recording
from tests.modp_ti.engine.stopped_runs import resumed_run
from tests.modp_ti.inputs.mjpeg_camera import MjpegCamera, encoded
from tests.patience import PATIENCE
from tests.room import Room, RoomRecording, pinhole, walk

ROOT = Path(__file__).parents[3]
LIVE = """
output:  out
device:  cpu
mapping: {optimise: {steps: 1}}
refine:  {steps: 0}
export:  {report: false}
"""
SAVED = {"splats.ply", "trajectory.txt", "frames.json", "colmap", "config.yaml"}

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("interruptible")]


class Run:
    """A run in a process of its own; `temporary` in its folder is for temporary files."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        (folder / "temporary").mkdir(exist_ok=True)
        environment = {**os.environ, "TMPDIR": str(folder / "temporary")}
        command = [sys.executable, "-m", "modp_ti.run", *arguments]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, env=environment, stderr=pipe, text=True, start_new_session=True)
        self.said = ""

    def end(self, number: int | None = None) -> int:
        if number is not None:
            self.process.send_signal(number)
        self.said += self.process.communicate(timeout=PATIENCE)[1]
        return self.process.returncode


def wait_for(condition: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    write_recording(folder, 16, 0.25, 2, 0)
    return folder


def test_a_file_run_saves_its_map_and_goes_on(recording: Path, tmp_path: Path) -> None:
    shutil.copytree(recording, tmp_path / "scene")
    scene, out = str(tmp_path / "scene" / "scene.yaml"), tmp_path / "scene" / "out"
    run = Run(tmp_path, scene, "--set", "refine.steps=1000000", "--set", "snapshot_every=4")
    wait_for((out / "snapshot.npz").exists)
    assert run.end(signal.SIGTERM) == 143, run.said
    assert set(os.listdir(out)) >= SAVED | {"snapshot.npz"}
    assert not list((tmp_path / "temporary").iterdir())
    assert run.said.strip().splitlines()[-1].startswith("error: interrupted after ")


@pytest.fixture(scope="module")
def jpegs() -> list[bytes]:
    images = RoomRecording(Room(), pinhole(160, 120), walk(60, 0.02)).images
    return [encoded(np.ascontiguousarray(image[..., ::-1])) for image in images]


@pytest.fixture
def camera(jpegs: list[bytes]) -> Iterator[MjpegCamera]:
    """A camera that walks to and fro."""
    made = MjpegCamera()
    stop = threading.Event()

    def film() -> None:
        while not stop.is_set():
            for data in jpegs + jpegs[::-1]:
                made.send_jpeg(data)
                if stop.wait(0.05):
                    break

    threading.Thread(target=film, daemon=True).start()
    yield made
    stop.set()
    made.shut_down()


def streamed(camera: MjpegCamera) -> str:
    known = pinhole(160, 120)
    source = f"source: {{stream: '{camera.url}', intrinsics: {{fx: {known.fx}, fy: {known.fy}, cx: 80, cy: 60}}}}\n"
    return source + "tracker: {kind: klt}\n" + LIVE


def test_the_frames_of_a_camera_survive_a_killed_run(camera: MjpegCamera, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(streamed(camera))
    run = Run(tmp_path, str(tmp_path / "scene.yaml"))
    wait_for(lambda: len(list((tmp_path / "temporary").glob("*live*/0*.png"))) > 25)
    assert run.end(signal.SIGKILL) == -signal.SIGKILL and "--resume" in run.said, "the tracker's process says so"
    (kept,) = (tmp_path / "temporary").glob("*live*")
    assert "secret" not in (tmp_path / "out" / "recording.yaml").read_text()
    resumed_run(tmp_path / "out")
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["frames"] > 4
    assert not kept.exists() and not list((tmp_path / "temporary").iterdir())
    assert not (tmp_path / "out" / "recording.yaml").exists()


def test_the_frames_of_another_tracker_survive_a_killed_run(recording: Path, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text("tracker: {kind: socket, path: server}\n" + LIVE)
    run = Run(tmp_path, str(tmp_path / "scene.yaml"))
    script = [sys.executable, str(ROOT / "scripts" / "send_frames.py"), str(recording / "scene.yaml")]
    options = ["--to", str(tmp_path / "server"), "--late", "1", "--wait", "300", "--rate", "4"]
    sender = subprocess.Popen([*script, *options], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_for((tmp_path / "out" / "recording.yaml").exists)
    with Image.open(next((recording / "images").iterdir())) as image:
        enough = 8 * (4 * image.width * image.height + 20_000)  # pixels, and some 400 points with the pose
    wait_for(lambda: sum(file.stat().st_size for file in (tmp_path / "temporary").glob("*/stream.modp")) > enough)
    assert run.end(signal.SIGKILL) == -signal.SIGKILL
    sender.kill()
    sender.wait()
    resumed_run(tmp_path / "out")
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["frames"] > 4
    assert not list((tmp_path / "temporary").iterdir())


def test_a_live_run_that_ends_itself_leaves_nothing_behind(camera: MjpegCamera, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(streamed(camera))
    run = Run(tmp_path, str(tmp_path / "scene.yaml"))
    wait_for(lambda: len(list((tmp_path / "temporary").glob("*live*/0*.png"))) > 25)
    assert run.end(signal.SIGTERM) == 0, "it ends the recording, and the map is finished"
    assert {"metrics.json", *SAVED} <= set(os.listdir(tmp_path / "out"))
    assert not (tmp_path / "out" / "recording.yaml").exists()
    assert not list((tmp_path / "temporary").iterdir())
