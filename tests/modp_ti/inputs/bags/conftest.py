"""Views of a textured plane, and the opening of bags of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.config.settings import SceneConfig
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.replay import ReplayedTracker
from tests.samples.filmed import View

Opened = Callable[..., ReplayedTracker]


@pytest.fixture(scope="package")
def views() -> list[View]:
    """Seven views, 320x240, of a textured plane z = 0, from an arc at distance 4."""
    rng = np.random.default_rng(3)
    noise = (rng.random((800 // size, 1000 // size, 3)).astype(np.float32) for size in (4, 8, 16, 40))
    texture = sum(cv2.resize(each, (1000, 800)) for each in noise)
    K = np.array([[300.0, 0, 161.5], [0, 298.0, 118.25], [0, 0, 1]])
    # From texels to the plane's x and y, homogeneous, with centres at +0.5.
    plane = np.array([[0.006, 0, -2.997], [0, 0.006, -2.397], [0, 0, 1]])
    result = []
    for n, angle in enumerate(np.linspace(-12.0, 12.0, 7)):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("yxz", [angle, 0.2 * angle, 3 * np.sin(n)], degrees=True).as_matrix()
        T[:3, 3] = T[:3, :3] @ [0, 0, -4.0]
        inverse = np.linalg.inv(T)
        homography = K @ np.column_stack([inverse[:3, 0], inverse[:3, 1], inverse[:3, 3]]) @ plane
        homography = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]]) @ homography  # to cv2's whole centres
        image = cv2.warpPerspective(np.asarray(60 * texture), homography, (320, 240), flags=cv2.INTER_AREA)
        image = np.clip(image, 0, 255).astype(np.uint8)
        result.append(View(image, K, T, lambda _, size: np.zeros(size[::-1])))
    return result


@pytest.fixture
def opened() -> Iterator[Opened]:
    """Open a bag as a run does: `opened(path, source settings, tracker settings...)`. It is closed after the test."""
    trackers: list[ReplayedTracker] = []

    def opened(place: Path, source: dict | None = None, **tracker: object) -> ReplayedTracker:
        settings = {"source": {"path": place, **(source or {})}, "tracker": {"kind": "bag", **tracker}, "output": "out"}
        result = open_tracker(SceneConfig.model_validate(settings))
        assert isinstance(result, ReplayedTracker)
        trackers.append(result)
        return result

    yield opened
    for tracker in trackers:
        tracker.close()
