"""Opening of recordings in tests: scenes in a folder, trackers by their settings, and captures without their images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import open_tree
from modp_ti.inputs.capture import Capture
from modp_ti.inputs.capture_reader import CaptureSettings
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import TrackerSettings
from modp_ti.inputs.readers import READERS, SOURCES
from modp_ti.inputs.replay import PosedImage, ReplayedTracker
from modp_ti.inputs.source_settings import SourceSettings
from tests.samples.filmed import View

CAPTURES = {kind: reader for kind, reader in READERS.items() if issubclass(reader, CaptureSettings)}


def opened(folder: Path, *overrides: str) -> ReplayedTracker:
    """The tracker of the folder's `scene.yaml`."""
    tracker = open_tracker(load_scene(folder / "scene.yaml", list(overrides)))
    assert isinstance(tracker, ReplayedTracker)
    return tracker


def refusal(folder: Path, *overrides: str) -> str:
    """The one line that the user gets for the folder's `scene.yaml`."""
    with pytest.raises(InputError) as caught:
        opened(folder, *overrides)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def opened_with(
    source: SourceSettings,
    tracker: TrackerSettings,
    progress: Progress | None = None,
    output: Path = Path("out"),
    seed: int = 0,
) -> ReplayedTracker:
    """The tracker of these settings."""
    opened = open_tracker(SceneConfig(source=source, tracker=tracker, output=output, seed=seed), progress)
    assert isinstance(opened, ReplayedTracker)
    return opened


def read_capture(path: Path, kind: str) -> Capture:
    """The frames of a capture."""
    reader = SOURCES[kind]
    assert issubclass(reader, CaptureSettings)
    return reader.read(next(tree for tree in open_tree(path) if reader.recognises(tree)))


def assert_poses(frames: Sequence, views: Sequence[View], atol: float = 1e-6) -> None:
    """The frames, as many as the views, have their poses."""
    poses = [np.zeros((4, 4)) if frame.T_camera_world is None else frame.T_camera_world for frame in frames]
    assert len(poses) == len(views)
    for pose, view in zip(poses, views, strict=True):
        np.testing.assert_allclose(pose, view.T_camera_world, rtol=0, atol=atol)


def off_pixels(frame: TrackedFrame | PosedImage) -> NDArray[np.float64]:
    """Distances (N,) [px] of the points from where the frame sees them."""
    camera = frame.camera if isinstance(frame, TrackedFrame) else frame.undistorter.camera
    p = frame.points.xyz @ frame.T_camera_world[:3, :3].T + frame.T_camera_world[:3, 3]
    return np.linalg.norm(camera.project(p) - frame.points.pixels, axis=1)
