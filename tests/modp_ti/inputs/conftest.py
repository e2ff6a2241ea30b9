"""A posed recording, and the files that trackers would have written of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.replay import ReplayedTracker


@dataclass(frozen=True)
class Recording:
    """The plane's views at 30 frames a second, and points on the plane z = 0 that they see.

    root: the folder beside `images`. T_camera_world: (N, 4, 4). xyz: (P, 3).
    """

    root: Path
    names: list[str]
    K: NDArray[np.float64]
    T_camera_world: NDArray[np.float64]
    xyz: NDArray[np.float64]

    @property
    def poses_in_world(self) -> NDArray[np.float64]:
        return np.linalg.inv(self.T_camera_world)

    def tum_lines(self, first_time: float = 0.0, per_second: float = 30.0) -> list[str]:
        """One line a frame: time tx ty tz qx qy qz qw, camera to world."""
        lines = []
        for i, T in enumerate(self.poses_in_world):
            numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
            lines.append(f"{first_time + i / per_second:.6f} " + " ".join(f"{number:.9f}" for number in numbers))
        return lines

    def write(self, name: str, lines: Iterable[str]) -> Path:
        file = self.root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("".join(line + "\n" for line in lines))
        return file

    def write_points(self, name: str = "points.txt") -> Path:
        return self.write(name, [" ".join(map(repr, row)) for row in self.xyz.tolist()])

    def open(self, kind: str, source: dict | None = None, **tracker) -> ReplayedTracker:
        K = self.K
        intrinsics = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        settings = {"path": self.root / "images", "intrinsics": intrinsics, **(source or {})}
        return open_tracker(
            SceneConfig.model_validate(
                {"source": settings, "tracker": {"kind": kind, **tracker}, "output": Path("out")}
            )
        )

    def failure(self, kind: str, source: dict | None = None, **tracker) -> str:
        """The one line that the user gets."""
        with pytest.raises(InputError) as caught:
            self.open(kind, source, **tracker)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    def assert_frames(self, tracker: ReplayedTracker, numbers: Iterable[int], least_points: int = 20) -> None:
        """The frames of these numbers, with their poses, and points on their pixels."""
        frames = tracker.frames
        numbers = list(numbers)
        assert [frame.name for frame in frames] == [self.names[i] for i in numbers]
        for frame, i in zip(frames, numbers, strict=True):
            np.testing.assert_allclose(frame.T_camera_world, self.T_camera_world[i], atol=1e-6)
            p = frame.points.xyz @ self.T_camera_world[i, :3, :3].T + self.T_camera_world[i, :3, 3]
            uv = (p / p[:, 2:]) @ self.K.T
            np.testing.assert_allclose(uv[:, :2], frame.points.pixels, atol=1e-3)
            assert len(frame.points) >= least_points


@pytest.fixture
def recording(plane_scene) -> Recording:
    rng = np.random.default_rng(5)
    xyz = np.c_[rng.uniform(-1.6, 1.6, (60, 2)), np.zeros(60)]
    return Recording(plane_scene.folder.parent, plane_scene.names, plane_scene.K, plane_scene.T_camera_world, xyz)
