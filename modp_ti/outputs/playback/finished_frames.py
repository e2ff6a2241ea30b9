"""`FinishedFrames`: the frames of a finished run as a mapper takes them, with their refined poses."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from modp_ti.inputs.trackers.colmap_files import read_colmap_model
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.run_pictures import Preparing, pictures

__all__ = ["FinishedFrames"]


class FinishedFrames:
    """The frames of a finished run, which can be iterated over repeatedly. Images are read one by one.

    The ids of the points are negative, so that they never are those of another tracker.

    Args:
        run: The finished run.
        preparing: Called while a tracker prepares, where the images have to be read through it.

    Raises:
        InputError: If the run's COLMAP model is damaged.
    """

    def __init__(self, run: FinishedRun, preparing: Preparing | None = None) -> None:
        self._run = run
        self._preparing = preparing
        model = read_colmap_model(run.folder / "colmap")
        place = {number: point.xyz for number, point in model.points3D.items()}
        self._points = []
        for number, camera in zip(sorted(model.images), run.cameras, strict=True):
            seen = model.images[number].get_observation_points2D()
            ids = np.array([point.point3D_id for point in seen], dtype=np.int64)
            pixels = np.array([point.xy for point in seen], dtype=np.float64).reshape(-1, 2)
            xyz = np.array([place[i] for i in ids.tolist()], dtype=np.float64).reshape(-1, 3)
            inside = camera.contains(pixels)
            self._points.append(SparsePoints(xyz[inside], pixels[inside], -ids[inside]))

    def __len__(self) -> int:
        return len(self._run)

    @property
    def size(self) -> tuple[int, int]:
        """Largest width and height of the images [px]."""
        cameras = self._run.cameras
        return max(camera.width for camera in cameras), max(camera.height for camera in cameras)

    @property
    def end(self) -> float:
        """Time of the last frame [s]."""
        return float(self._run.timestamps.max())

    def __iter__(self) -> Iterator[TrackedFrame]:
        run, held_out = self._run, set(self._run.record.held_out)
        with closing(pictures(run, self._preparing)) as images:
            for index, picture in enumerate(images):
                yield TrackedFrame(
                    index=index,
                    timestamp=float(run.timestamps[index]),
                    name=run.names[index],
                    image=picture.image,
                    camera=run.cameras[index],
                    T_camera_world=run.poses[index],
                    points=self._points[index],
                    mask=picture.mask,
                    vignette=picture.vignette,
                    held_out=index in held_out,
                )
