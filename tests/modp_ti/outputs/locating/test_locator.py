"""Pictures of the test room, taken from known poses, in a map of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3, inverse_se3
from modp_ti.inputs.source_settings import IntrinsicsSettings
from modp_ti.outputs.locating.locator import Location, Locator
from tests.modp_ti.outputs.locating.painted_room import CAMERA, another_room, photograph, write_run
from tests.room import Room, walk

pytestmark = pytest.mark.slow

K1 = -0.08
# Of pictures of 240 pixels at 3 m, against a map of overlapping Gaussians that nothing has optimised [m, degrees].
AWAY, TURNED = 0.05, 1.0


@pytest.fixture(scope="module")
def out(made_once: Callable[[str, Callable[[Path], None]], Path], room: Room) -> Path:
    return made_once("a painted room", lambda folder: (write_run(room, folder / "out", K1), None)[1]) / "out"


@pytest.fixture(scope="module")
def locator(out: Path) -> Locator:
    return Locator(out, "cpu")


def new_poses() -> list[NDArray[np.float64]]:
    """Between the keyframes, up to 20 cm beside them, and turned by up to 6 degrees."""
    rng = np.random.default_rng(5)
    between = walk(13, step=0.1)[3:11:2]
    return [exp_se3(rng.uniform(-1, 1, 6) * np.repeat([0.12, 0.06], 3)) @ T for T in between]


def errors(location: Location, T: NDArray[np.float64]) -> tuple[float, float]:
    """Distance [m] and angle [degrees] from the true pose."""
    assert location.T_camera_world is not None, location.reason
    turned = location.T_camera_world[:3, :3] @ T[:3, :3].T
    away = np.linalg.norm(inverse_se3(location.T_camera_world)[:3, 3] - inverse_se3(T)[:3, 3])
    return float(away), float(np.degrees(np.arccos(min((np.trace(turned) - 1) / 2, 1.0))))


def test_pictures_by_the_runs_camera_are_located(locator: Locator, room: Room) -> None:
    """At the size of the stored images, through their lens."""
    double = CAMERA.resized(2 * CAMERA.width, 2 * CAMERA.height)
    for T in new_poses()[:2]:
        location = locator.locate(photograph(room, double, T, K1))
        away, turned = errors(location, T)
        assert away < AWAY and turned < TURNED
        assert location.inliers >= 20 and location.likeness > 0.9


@pytest.mark.parametrize("light", [(1.0, 1.0, 1.0), (0.5, 0.6, 0.55)])
def test_an_undistorted_picture_of_the_mapped_size_is_located_a_darker_one_too(
    locator: Locator, room: Room, light: tuple[float, float, float]
) -> None:
    T = new_poses()[1]
    away, turned = errors(locator.locate((photograph(room, CAMERA, T) * light).astype(np.uint8)), T)
    assert away < AWAY and turned < TURNED


def test_an_unknown_camera_gets_a_focal_length(locator: Locator, room: Room) -> None:
    """A square cut out of the middle, whose shape is not that of the run's images."""
    T = new_poses()[2]
    cut = np.ascontiguousarray(photograph(room, CAMERA, T)[:, 30:210])
    location = locator.locate(cut)
    away, turned = errors(location, T)
    assert away < 3 * AWAY and turned < 3 * TURNED
    assert location.camera is not None and location.camera.fx == pytest.approx(CAMERA.fx, rel=0.05)
    assert "estimated" in location.note
    given = locator.locate(cut, IntrinsicsSettings(fx=CAMERA.fx))
    assert errors(given, T)[0] < AWAY and "given" in given.note


def test_other_places_are_not_located(locator: Locator) -> None:
    elsewhere = another_room()
    rng = np.random.default_rng(0)
    pictures = [photograph(elsewhere, CAMERA, T) for T in new_poses()[:2]]
    pictures.append(rng.integers(0, 256, (180, 240, 3), dtype=np.uint8))
    pictures.append(np.zeros((180, 240, 3), np.uint8))
    for picture in pictures:
        location = locator.locate(picture)
        assert location.T_camera_world is None and location.reason
