"""Views of the textured plane, and the opening of captures of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from modp_ti.config.settings import SceneConfig
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.replay import ReplayedTracker
from tests.captures import View

Opened = Callable[..., ReplayedTracker]


def plane_depth(T_world_camera: NDArray, K: NDArray, size: tuple[int, int]) -> NDArray:
    """Depths of the plane z = 0 of the world."""
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones_like(rows)], axis=-1)
    return -T_world_camera[2, 3] / (rays @ T_world_camera[2, :3])


@pytest.fixture
def views(plane_scene) -> list[View]:
    """Seven views of the plane."""
    result = []
    for name, T in zip(plane_scene.names, plane_scene.T_camera_world, strict=True):
        there = np.linalg.inv(T)
        image = np.asarray(cv2.imread(str(plane_scene.folder / name)), np.uint8)
        result.append(View(image, plane_scene.K, there, lambda K, size, there=there: plane_depth(there, K, size)))
    return result


@pytest.fixture
def opened() -> Opened:
    """Open a capture as a run does: `opened(path, kind, source settings, tracker settings...)`."""

    def opened(place: Path, kind: str, source: dict | None = None, **tracker: object) -> ReplayedTracker:
        settings = {"source": {"path": place, **(source or {})}, "tracker": {"kind": kind, **tracker}, "output": "out"}
        result = open_tracker(SceneConfig.model_validate(settings))
        assert isinstance(result, ReplayedTracker)
        return result

    return opened
