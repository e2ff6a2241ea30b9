"""`Mapper`: maps frames that the caller provides. `modp-ti run` uses the same class."""

from __future__ import annotations

import operator
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import far_origin, shifted, shifted_poses
from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.runtime.tenancy import Tenant, in_engine
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import PRIVATE, appearing
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.outputs.evaluation import MapVersion
from modp_ti.outputs.formats.dataset import image_names
from modp_ti.outputs.formats.run_files import NOT_ALWAYS, write_map
from modp_ti.outputs.formats.splats_ply import write_splats
from pipelines.companions.block_files import BlockError
from pipelines.companions.pace import Pace
from pipelines.offline import OfflineMapper
from pipelines.online import OnlineMapper
from pipelines.pipeline import FrameReport, NothingToMapError, Pipeline
from pipelines.refinement import Schedule, refine
from pipelines.render.renderer import RenderedView
from pipelines.settings import MappingSettings, OfflineSettings, RefineSettings
from pipelines.state import MapState, restore_state


@in_engine("add", "take", "correct", "finish", "refine", "restore", "trajectory", "render", "version", "save")
class Mapper(Tenant):
    """Maps frames of up to `width` x `height` pixels as they arrive.

    `initialise` must be called first. A process has room for one map; close it before making another, for example by
    using it as a context manager. Any thread may call it; a call waits until the one before it has ended.

    Args:
        width: Largest image width [px].
        height: Largest image height [px].
        settings: Settings of the online loop, or of the offline baseline, which builds its map in `finish`. None for
            the online loop's defaults.
        seed: Seed of the random numbers.
        pace: How much work a frame of the online loop gets; None for all of the settings.
        folder: Folder for the parts of an online map that go to disk; None for a temporary one.

    Attributes:
        pipeline: The online or offline mapper, with its Gaussians, keyframes and renderer.
        frames: Metadata and tracked points of all frames so far, without their images.
        finished: Whether `finish` has run since the last frame was added.

    Raises:
        RuntimeError: If `initialise` has not been called, or the process holds another map. Every method raises it
            once the map is gone, after `close` or another `initialise`.

    Example:
        modp_ti.initialise("cpu")
        mapper = modp_ti.Mapper(width=640, height=480)
        for frame in frames:  # of class `TrackedFrame`
            mapper.add(frame)
        mapper.save("out/room")
    """

    def __init__(
        self,
        width: int,
        height: int,
        settings: MappingSettings | OfflineSettings | None = None,
        seed: int = 0,
        pace: Pace | None = None,
        folder: Path | None = None,
    ) -> None:
        self.pipeline: Pipeline
        if isinstance(settings, OfflineSettings):
            self.pipeline = OfflineMapper(settings, width, height, seed)
        else:
            self.pipeline = OnlineMapper(settings or MappingSettings(), width, height, seed, pace=pace, folder=folder)
        self.tenancy = self.pipeline.tenancy
        self.frames = DeliveredFrames(trajectory=self.pipeline.trajectory)
        self.finished = True

    def add(self, frame: TrackedFrame) -> FrameReport | None:
        """Process the next frame. Frames must come in increasing order of their indices, and no time may fall.

        Returns:
            What the frame did to the map, or None if it is held out and hence does not change the map.

        Raises:
            ValueError: If the frame is out of order or larger than the mapper's images.
            BlockError: If a part of the map that lies on disk is damaged. The map is left without it.
        """
        if self.frames.index and frame.index > self.frames.index[-1] and frame.timestamp < self.frames.timestamp[-1]:
            before = self.frames.timestamp[-1]
            raise ValueError(f"{frame.name} has the time {frame.timestamp} s, the frame before it {before} s")
        return self.take(frame)

    def take(self, frame: TrackedFrame) -> FrameReport | None:
        """Process the next frame as `add` does, whatever its time: those of joined recordings may fall."""
        size, images = frame.camera, self.pipeline.renderer.images
        if not self.takes(size.width, size.height):
            raise ValueError(
                f"{frame.name} is {size.width}x{size.height}, the mapper was made for images up to "
                f"{images.max_width}x{images.max_height}"
            )
        if self.frames.index and frame.index <= self.frames.index[-1]:
            raise ValueError(f"{frame.name} has index {frame.index}, the frame before it {self.frames.index[-1]}")
        frame = self._near(frame)
        try:
            report = None if frame.held_out else self.pipeline.process(frame)
        except BlockError:
            self._note(frame)  # the map that is left has it
            raise
        self._note(frame)
        self.finished = False
        return report

    def takes(self, width: int, height: int) -> bool:
        """Return whether images of this size [px] fit the mapper."""
        images = self.pipeline.renderer.images
        return width <= images.max_width and height <= images.max_height

    def correct(self, correction: PoseCorrection, more: bool = False) -> None:
        """Apply poses and points that the tracker has revised, for example after a loop closure.

        Args:
            correction: The revised poses and points.
            more: Whether another correction follows at once, with which the Gaussians then move.

        Raises:
            InputError: If the correction refers to a frame that has not been added yet.
        """
        last = self.frames.index[-1] if self.frames.index else None
        if last is None or correction.index[-1] > last:
            after = "" if last is None else f" after frame {last},"
            raise InputError(f"the tracker corrects frame {correction.index[-1]}{after} before it has come")
        correction = shifted(correction, -self.frames.from_origin)
        report = self.pipeline.correct(correction, more)
        self.frames.correct(correction, report.around, report.moved)

    def finish(self, progress: Callable[[int, int, float], None] | None = None) -> None:
        """Run what follows the last frame of the online loop, or the whole optimisation of the offline baseline.

        Does nothing if no frame was added since the last call. More frames may follow.

        Args:
            progress: Callback of the offline baseline, see `OfflineMapper.optimise`.

        Raises:
            InputError: If the offline baseline has no tracked points to start from.
        """
        if self.finished:
            return
        try:
            self.pipeline.finish(progress)
        except NothingToMapError as error:
            raise InputError(f"`mode: offline` starts from tracked points: {error}") from None
        self.finished = True

    def refine(
        self,
        steps: int,
        settings: RefineSettings | None = None,
        progress: Callable[[int, float], None] | None = None,
        done: int = 0,
        schedule: Schedule | None = None,
    ) -> None:
        """Call `finish`, then optimise the map on all keyframes equally. More frames may follow.

        Args:
            steps: Number of refinement steps, 0 or more. It replaces `settings.steps` and `settings.seconds`.
            settings: The other settings of the refinement, None for the defaults.
            progress: Callback, see `pipelines.refinement.refine`.
            done: Steps that were done before, see `pipelines.refinement.refine`.
            schedule: When the refinement ends instead of after `steps`, see `pipelines.refinement.refine`.

        Raises:
            TypeError, ValueError: If `steps` is no such number.
            ValueError: If the map is an offline one, whose optimisation already covers all frames.
        """
        if operator.index(steps) < 0:
            raise ValueError(f"a refinement has 0 steps or more, not {steps}")
        pipeline = self.online
        self.finish()
        settings = RefineSettings() if settings is None else settings
        settings = settings.model_copy(update={"steps": steps, "seconds": None})
        refine(pipeline, settings, progress, done, schedule)

    def restore(self, state: MapState, frames: DeliveredFrames, again: Iterable[TrackedFrame], finished: bool) -> None:
        """Restore the state of another mapper with the same settings.

        Args:
            state: The state of the other mapper's `online`, see `pipelines.state`.
            frames: The other mapper's `frames`, with the trajectory of this mapper's pipeline.
            again: The frames that it processed, without the held-out ones.
            finished: The other mapper's `finished`.

        Raises:
            KeyError, TypeError, ValueError: If the state does not fit this mapper.
        """
        pipeline = self.online
        self.frames.origin = frames.origin
        restore_state(pipeline, state, map(self._near, again))
        if list(self.pipeline.trajectory) != frames.index:
            raise ValueError("the frames differ from those with tracked poses")
        self.frames = frames
        self.pipeline.count_beside(frames.points.nbytes)
        self.finished = finished

    def noted(self, frames: Iterable[TrackedFrame]) -> Iterator[TrackedFrame]:
        """Yield frames near the map's origin and keep their metadata, for what puts finished maps into `online`.

        Args:
            frames: All frames of the finished maps, in order. More may follow once they have been iterated over.
        """
        for frame in map(self._near, frames):
            yield frame
            self._note(frame)
        self.finished = True

    @property
    def online(self) -> OnlineMapper:
        """The pipeline of an online map.

        Raises:
            ValueError: If the map is an offline one, which is neither refined nor continued.
        """
        if not isinstance(self.pipeline, OnlineMapper):
            raise ValueError("an offline map is neither refined nor continued: give its settings more steps")
        return self.pipeline

    def _near(self, frame: TrackedFrame) -> TrackedFrame:
        """Return a frame in coordinates from the map's origin, which the first one decides."""
        if self.frames.origin is None:
            self.frames.origin = far_origin(frame.T_camera_world, frame.points)
        return shifted(frame, -self.frames.origin)

    def _note(self, frame: TrackedFrame) -> None:
        """Keep the metadata of a frame that was mapped, and its points as far as the memory budget allows."""
        self.frames.add(frame, with_points=self.pipeline.takes_observations(len(frame.points)))
        self.pipeline.count_beside(self.frames.points.nbytes)

    def trajectory(self) -> list[NDArray[np.float64]]:
        """Return the refined T_camera_world (4, 4) of every frame so far, in the world of the frames."""
        return [shifted_poses(T, self.frames.from_origin) for T in self._trajectory()]

    def _trajectory(self) -> list[NDArray[np.float64]]:
        """The refined poses in coordinates from the map's origin."""
        store = self.pipeline.keyframes
        return [store.corrected(i, T) for i, T in self.pipeline.trajectory.items()]

    def render(
        self,
        camera: PinholeCamera,
        T_camera_world: NDArray[np.float64] | None = None,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> RenderedView:
        """Render the map.

        Args:
            camera: The camera, at most as large as the mapper's images.
            T_camera_world: (4, 4) pose in the world of the frames, None for the refined pose of the last frame.
            background: RGB colour behind the map.

        Returns:
            Colour (not clipped), depth and opacity.

        Raises:
            ValueError: If `T_camera_world` is None before the first frame, or the camera is too large.
        """
        if T_camera_world is None:
            if not self.frames.index:
                raise ValueError("there is no frame yet whose place to look from: give T_camera_world")
            last = self.frames.index[-1]
            T_near = self.pipeline.keyframes.corrected(last, self.pipeline.trajectory[last])
        else:
            T_near = shifted_poses(T_camera_world, -self.frames.from_origin)
        return self.pipeline.renderer.render(camera, T_near, self.pipeline.near, background)

    def version(self) -> MapVersion:
        """Return a copy of the current map on the host, in coordinates from `frames.origin`."""
        store = self.pipeline.keyframes
        return MapVersion(
            self.pipeline.all_gaussians(),
            self._trajectory(),
            [store.exposure_at(i) for i in self.frames.index],
            self.pipeline.renderer.view_renders,
        )

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the current map. All files appear together or not at all.

        Args:
            path: A folder, which gets `splats.ply`, `trajectory.txt`, `frames.json` and `colmap/` as in a run's output
                and keeps its other files; or a path that ends in `.ply`, for the Gaussians alone.

        Returns:
            The path as a `Path`.

        Raises:
            InputError: If the files cannot be written, or would replace something that is not of a run.
        """
        path = Path(path)
        if path.suffix == ".ply":
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                write_splats(path, self.pipeline.all_gaussians(), self.frames.from_origin)
            except OSError as error:
                raise InputError(f"{path}: cannot be written: {error.strerror}") from None
            return path
        with appearing(path.absolute(), NOT_ALWAYS) as folder:
            names = image_names(self.frames.name, written=False)
            write_map(folder, self.version(), self.frames, names, self.pipeline.keyframes, self.pipeline.near)
        return path


def build_mapper(config: SceneConfig, camera: PinholeCamera, pace: Pace | None = None) -> Mapper:
    """Create the mapper for the scene's mode and for images of this camera.

    Args:
        config: The scene's settings.
        camera: The camera.
        pace: Pace of the online loop, None for all the work of the settings.

    Raises:
        InputError: If the settings do not fit the images.
    """
    settings = config.offline if config.mode == "offline" else config.mapping
    try:
        return Mapper(camera.width, camera.height, settings, config.seed, pace, config.output / PRIVATE)
    except ValueError as error:
        raise InputError(str(error)) from None
