"""The list of cameras, from a made-up /sys tree and a capture that opens what the test says."""

from __future__ import annotations

import json

import cv2
import pytest
from typer.testing import CliRunner

from modp_ti.commands import app as cli
from modp_ti.inputs.sources import cameras
from modp_ti.inputs.sources.cameras import Camera, find_cameras


@pytest.fixture
def capture(monkeypatch):
    """Numbers of the cameras that open, with their properties; and the numbers that were opened and released."""
    opening: dict[int, dict[int, float]] = {}
    log: list[tuple[str, int]] = []

    class FakeCapture:
        def __init__(self, number: int) -> None:
            self.number = number
            log.append(("opened", number))

        def isOpened(self) -> bool:  # noqa: N802 - the name in OpenCV
            return self.number in opening

        def get(self, key: int) -> float:
            return opening[self.number].get(key, 0.0)

        def release(self) -> None:
            log.append(("released", self.number))

    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    return opening, log


@pytest.fixture
def devices(tmp_path):
    """Adds a device as Linux lists them: returns the folder, and a function of number, name and index."""
    folder = tmp_path / "video4linux"

    def add(number: int, name: str, index: int = 0) -> None:
        (folder / f"video{number}").mkdir(parents=True)
        (folder / f"video{number}" / "name").write_text(f"{name}\n")
        (folder / f"video{number}" / "index").write_text(f"{index}\n")

    return folder, add


VGA = {cv2.CAP_PROP_FRAME_WIDTH: 640.0, cv2.CAP_PROP_FRAME_HEIGHT: 480.0, cv2.CAP_PROP_FPS: 30.0}


def test_cameras_of_linux_have_names_and_only_the_device_that_delivers_images_counts(capture, devices):
    opening, log = capture
    folder, add = devices
    for number, name, index in [(10, "Grabber", 0), (0, "HD Webcam", 0), (1, "HD Webcam", 1), (2, "In Use", 0)]:
        add(number, name, index)
    (folder / "v4l-subdev0").mkdir()
    opening |= {0: VGA, 10: {cv2.CAP_PROP_FPS: -1.0}}
    assert find_cameras(folder) == [
        Camera(0, "HD Webcam", 640, 480, 30.0),
        Camera(2, "In Use", opens=False),
        Camera(10, "Grabber"),
    ]
    assert sorted(n for what, n in log if what == "released") == [0, 10]


def listed(*arguments: str):
    return CliRunner().invoke(cli.app, ["cameras", *arguments])


def test_the_command_prints_a_line_a_camera_and_one_object_for_programs(capture, devices, monkeypatch):
    opening, _ = capture
    folder, add = devices
    monkeypatch.setattr(cameras, "LINUX_DEVICES", folder)
    add(0, "HD Webcam\x1b[2J")
    add(2, "Grabber")
    opening |= {0: VGA}
    result = listed("--quiet")
    assert result.exit_code == 0
    assert result.stdout.splitlines() == [
        "0  HD Webcam\\x1b[2J, 640x480, 30 a second",
        "2  Grabber, cannot be opened: in use by another program, or not permitted",
    ]
    data = json.loads(listed("--json").stdout)
    assert data["exit_code"] == 0
    assert [(camera["number"], camera["fps"], camera["opens"]) for camera in data["cameras"]] == [
        (0, 30.0, True),
        (2, None, False),
    ]
