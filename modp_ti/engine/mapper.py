"""`Mapper`: a map of the frames that one hands over, from one's own loop as from that of a run."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.runtime.backend import program
from modp_ti.files.errors import InputError
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.outputs.evaluation import MapVersion
from modp_ti.outputs.formats.colmap_model import image_names
from modp_ti.outputs.formats.map_folder import appearing, write_map
from modp_ti.outputs.formats.splats_ply import write_splats
from pipelines.offline import OfflineMapper
from pipelines.online import OnlineMapper
from pipelines.pipeline import FrameReport, NothingToMapError, Pipeline
from pipelines.render.renderer import RenderedView
from pipelines.settings import MappingSettings, OfflineSettings, RefineSettings
from pipelines.state import MapState

__all__ = ["Mapper"]


class Mapper:
    """Maps frames of up to `width` x `height` pixels while they come; `initialise` must have been called.

    settings: of the online loop, or those of the offline baseline, which makes its map in `finish`. pipeline: what
    makes the map, with its Gaussians, keyframes and renderer. frames: what is kept of the frames so far.

    A process has room for one map of a room's size; `initialise` frees it for another.
    """

    def __init__(
        self, width: int, height: int, settings: MappingSettings | OfflineSettings | None = None, seed: int = 0
    ) -> None:
        program()
        self.pipeline: Pipeline
        if isinstance(settings, OfflineSettings):
            self.pipeline = OfflineMapper(settings, width, height, seed)
        else:
            self.pipeline = OnlineMapper(settings or MappingSettings(), width, height, seed)
        self.frames = DeliveredFrames()
        self._finished = True

    def add(self, frame: TrackedFrame) -> FrameReport | None:
        """Take in the next frame; what it did to the map, None where it is held out, which leaves the map alone.

        Frames come in the order of their indices. Raises ValueError for one that does not, or is too large.
        """
        size, images = frame.camera, self.pipeline.renderer.images
        if size.width > images.max_width or size.height > images.max_height:
            raise ValueError(
                f"{frame.name} is {size.width}x{size.height}, the mapper was made for images up to "
                f"{images.max_width}x{images.max_height}"
            )
        if self.frames.index and frame.index <= self.frames.index[-1]:
            raise ValueError(f"{frame.name} has index {frame.index}, the frame before it {self.frames.index[-1]}")
        report = None if frame.held_out else self.pipeline.process(frame)
        self._keep(frame)
        self._finished = False
        return report

    def _keep(self, frame: TrackedFrame) -> None:
        """Keep what is kept of every frame, as far as there is room beside the map."""
        self.frames.add(frame, with_points=self.pipeline.takes_observations(len(frame.points)))
        self.pipeline.count_beside(self.frames.points.nbytes)

    def correct(self, correction: PoseCorrection) -> None:
        """Take over poses and points that the tracker has revised. Raises InputError for frames that have not come."""
        if correction.index[-1] > self.frames.index[-1]:
            raise InputError(
                f"the tracker corrects frame {correction.index[-1]} after frame {self.frames.index[-1]}, "
                "before it has come"
            )
        report = self.pipeline.correct(correction)
        self.frames.correct(correction, report.motion, report.moved)

    def finish(self, progress: Callable[[int, int, float], None] | None = None) -> None:
        """What follows the last frame of the online loop, or all steps of the offline one.

        Done already, it waits for more frames. progress: of the offline loop, see `OfflineMapper.optimise`.
        """
        if self._finished:
            return
        self._finished = True
        try:
            self.pipeline.finish(progress)
        except NothingToMapError as error:
            raise InputError(f"`mode: offline` starts from tracked points: {error}") from None

    def refine(
        self,
        steps: int,
        settings: RefineSettings | None = None,
        progress: Callable[[int, float], None] | None = None,
        done: int = 0,
    ) -> None:
        """Finish the map, and optimise it for all keyframes alike. More frames may follow.

        settings: all but its own number of steps. progress, done: see `pipelines.refinement.refine`. Raises ValueError
        for an offline map, which has been.
        """
        if not self.pipeline.can_be_refined:
            raise ValueError("an offline map is not refined: give its settings more steps")
        self.finish()
        settings = RefineSettings() if settings is None else settings
        self.pipeline.refine(settings.model_copy(update={"steps": steps}), progress, done)

    @property
    def finished(self) -> bool:
        """Whether the frames so far have had what follows the last one."""
        return self._finished

    def restore(self, state: MapState, frames: DeliveredFrames, again: Iterable[TrackedFrame], finished: bool) -> None:
        """Become what another mapper of the same settings was: `pipeline.state()`, `frames` and `finished` of it.

        again: the same frames as it took in, held-out ones left out. Raises as `OnlineMapper.restore`.
        """
        self.pipeline.restore(state, again)
        self.frames = frames
        self.pipeline.count_beside(frames.points.nbytes)
        self._finished = finished

    def trajectory(self) -> list[NDArray[np.float64]]:
        """Refined T_camera_world (4, 4) of every frame so far."""
        store = self.pipeline.keyframes
        return [store.corrected(i, T) for i, T in zip(self.frames.index, self.frames.T_tracked, strict=True)]

    def render(
        self,
        camera: PinholeCamera,
        T_camera_world: NDArray[np.float64] | None = None,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> RenderedView:
        """The map through a camera of up to the mapper's size, from T_camera_world (4, 4).

        T_camera_world: None for where the last frame was taken. Raises ValueError where that is nowhere, or the size is
        beyond the mapper's.
        """
        if T_camera_world is None:
            if not self.frames.index:
                raise ValueError("there is no frame yet whose place to look from: give T_camera_world")
            last = self.frames.index[-1]
            T_camera_world = self.pipeline.keyframes.corrected(last, self.frames.T_tracked[-1])
        return self.pipeline.renderer.render(camera, T_camera_world, self.pipeline.near, background)

    def version(self) -> MapVersion:
        """The map as it stands, on the host."""
        store = self.pipeline.keyframes
        return MapVersion(
            self.pipeline.gaussians.to_numpy(),
            self.trajectory(),
            [store.exposure_at(i) for i in self.frames.index],
            self.pipeline.renderer.view_renders,
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the map as it stands; the path.

        A folder, which then holds `splats.ply`, `trajectory.txt` and `colmap/` as the output of a run does, and what
        it held besides; or, where the path ends in .ply, the Gaussians alone. All appears together or not at all.
        Raises InputError where it cannot be written.
        """
        path = Path(path)
        if path.suffix == ".ply":
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                write_splats(path, self.pipeline.gaussians.to_numpy())
            except OSError as error:
                raise InputError(f"{path}: cannot be written: {error.strerror}") from None
            return path
        with appearing(path.absolute()) as folder:
            names = image_names(self.frames.name, written=False)
            write_map(folder, self.version(), self.frames, names, self.pipeline.keyframes, self.pipeline.near)
        return path
