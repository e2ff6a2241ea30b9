"""The scale by markers whose size is known, in pictures drawn from known cameras."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from fields.geometry.se3 import inverse_se3
from modp_ti.files.errors import InputError
from modp_ti.outputs.locating.markers import FAMILIES, marker_scale
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run
from modp_ti.outputs.progress import ProgressLine
from tests.modp_ti.outputs.locating.painted_room import CAMERA, write_run
from tests.room import Room

LINE = ProgressLine(Console(quiet=True))
EDGE = 0.4  # of the markers in the room's metres
FINE = 4


def drawn(run: FinishedRun, family: str, shift: float = 0.0) -> None:
    """Write images of two markers on grey, 1.5 m before the first camera; `shift` moves the second to and fro."""
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
    camera = CAMERA.resized(FINE * CAMERA.width, FINE * CAMERA.height)
    T_world_first = inverse_se3(run.poses[0])
    images = run.folder / "colmap" / "images"
    images.mkdir(exist_ok=True)
    for place, name in enumerate(run.names):
        image = np.full((camera.height, camera.width), 190, np.uint8)
        for number, middle in ((3, [-0.35, 0.0]), (5, [0.35, 0.1])):
            tag = cv2.copyMakeBorder(
                cv2.aruco.generateImageMarker(dictionary, number, 200), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255
            )
            half = 0.5 * EDGE * 280 / 200
            square = np.array([[-half, -half], [half, -half], [half, half], [-half, half]]) + middle
            at = np.c_[square, np.full(4, 1.5)]
            at[:, 0] += shift * (number == 5) * (place % 2)
            seen = at @ T_world_first[:3, :3].T + T_world_first[:3, 3]
            seen = camera.project(seen @ run.poses[place][:3, :3].T + run.poses[place][:3, 3])
            of_tag = np.array([[0, 0], [280, 0], [280, 280], [0, 280]], dtype=np.float32)
            H = cv2.getPerspectiveTransform(of_tag - 0.5, (seen - 0.5).astype(np.float32))
            warped = cv2.warpPerspective(tag, H, image.shape[::-1], flags=cv2.INTER_AREA)
            inside = cv2.warpPerspective(np.full_like(tag, 255), H, image.shape[::-1])
            image = np.where(inside > 127, warped, image)
        small = cv2.resize(image, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_AREA)
        (images / name).write_bytes(cv2.imencode(".png", small)[1].tobytes())


@pytest.fixture(scope="module")
def run(room: Room, tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    folder: Path = tmp_path_factory.mktemp("markers") / "out"
    write_run(room, folder)
    return open_run(folder)


@pytest.mark.parametrize("family", ["tag36h11", "4x4"])
def test_markers_give_the_scale_to_half_a_percent(run: FinishedRun, family: str) -> None:
    drawn(run, family)
    factor, deviation, count = marker_scale(run, family, 2.5 * EDGE, LINE)
    assert count == 2
    assert factor == pytest.approx(2.5, rel=0.005)
    assert deviation < 0.005


def test_a_marker_that_was_moved_is_not_used(run: FinishedRun) -> None:
    drawn(run, "tag36h11", shift=0.05)
    factor, _, count = marker_scale(run, "tag36h11", EDGE, LINE)
    assert count == 1
    assert factor == pytest.approx(1.0, rel=0.005)


def test_without_markers_of_the_family_there_is_no_scale(run: FinishedRun) -> None:
    drawn(run, "4x4")
    with pytest.raises(InputError, match="tag36h11"):
        marker_scale(run, "tag36h11", EDGE, LINE)
