"""Offline 3D Gaussian Splatting [Kerbl 2023] with the same renderer: the paper's baseline (Section 4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.gaussians import GaussianField
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from fields.map.trajectory import Trajectory
from fields.runtime.tenancy import in_engine, settled
from pipelines.corrections import CorrectionReport, revise
from pipelines.densify.adaptive_density import AdaptiveDensity, initialise, union_of_points
from pipelines.optimise.adam import Adam, LearningRates
from pipelines.pipeline import FrameReport, NothingToMapError, Pipeline, Stopwatch
from pipelines.refinement import decay
from pipelines.render.formulas import LossValues
from pipelines.render.renderer import Renderer
from pipelines.safeguards import EXPLODED, Safeguards
from pipelines.settings import OfflineSettings

# Length of the published run, to which the step numbers in the settings refer.
PUBLISHED_STEPS = 30_000
# Density control starts once the map resembles the scene, which takes the same number of steps in a short run. Its
# start and interval therefore do not scale with the run, but are at most this fraction of it.
LONGEST_WAIT = 1 / 12
# Minimum interval between opacity resets. An opacity takes some hundred steps to recover. With shorter intervals, the
# rounds of density control would mostly see the recovery.
LEAST_STEPS_BETWEEN_RESETS = 1_500
# Minimum extent of a scene [scene depths], for cameras that only rotate.
LEAST_EXTENT = 0.01
# Minimum standard deviation of an initial Gaussian [extents].
LEAST_SIZE = 1e-5


@dataclass(frozen=True)
class Schedule:
    """Step numbers of a run, scaled from those of the published run where possible. Steps count from 1.

    Attributes:
        steps: Number of optimisation steps.
        highest_degree: Final degree of the spherical harmonics.
        sh_every: Steps after which the degree increases by one.
        densify_from: Step after which density control starts.
        densify_until: Step at which density control ends.
        densify_every: Interval of density control.
        reset_every: Interval of opacity resets.
    """

    steps: int
    highest_degree: int
    sh_every: int
    densify_from: int
    densify_until: int
    densify_every: int
    reset_every: int

    @classmethod
    def of(cls, settings: OfflineSettings) -> Schedule:
        """Compute the schedule of a run with these settings."""

        def scaled(step: int) -> int:
            return max(round(step * settings.steps / PUBLISHED_STEPS), 1)

        longest_wait = max(round(settings.steps * LONGEST_WAIT), 1)
        return cls(
            steps=settings.steps,
            highest_degree=settings.sh_degree,
            sh_every=scaled(settings.sh_every),
            densify_from=min(settings.densify_from, longest_wait),
            densify_until=scaled(settings.densify_until),
            densify_every=min(settings.densify_every, longest_wait),
            reset_every=max(scaled(settings.reset_every), LEAST_STEPS_BETWEEN_RESETS),
        )

    def sh_degree(self, step: int) -> int:
        """Highest degree of the harmonics that are optimised in this step."""
        return min(step // self.sh_every, self.highest_degree)

    def adapts_at(self, step: int) -> bool:
        """Whether Gaussians are cloned, split and pruned after this step."""
        return self.densify_from < step < self.densify_until and step % self.densify_every == 0

    def resets_at(self, step: int) -> bool:
        """Whether opacities are reset after this step."""
        return step < self.densify_until and step % self.reset_every == 0


def scene_extent(store: KeyframeStore) -> float:
    """Extent of a scene, the unit of length of 3DGS's settings [scene units].

    This is 1.1 times the largest distance of a camera from the mean camera centre, and at least `LEAST_EXTENT` scene
    depths. Raises ValueError if there is no view.
    """
    if len(store) == 0:
        raise ValueError("there is no frame to map")
    centres = np.array([view.centre for view in store])
    radius = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    return max(1.1 * radius, LEAST_EXTENT * store.scene_depth)


@in_engine("process", "initialise", "optimise", "finish", "compile")
class OfflineMapper(Pipeline):
    """Offline 3DGS: collects all frames, then optimises Gaussians on one random view per step.

    `process` only stores the frames, and `keyframes` holds all of them at their tracked poses. `finish` builds the map:
    it calls `initialise`, which creates Gaussians from the tracked points, and `optimise`.

    Args:
        settings: Settings of the offline mapper.
        max_width: Largest image width [px].
        max_height: Largest image height [px].
        seed: Seed of the random generator.
    """

    def __init__(self, settings: OfflineSettings, max_width: int, max_height: int, seed: int = 0) -> None:
        self.settings: OfflineSettings = settings
        self.rng = np.random.default_rng(seed)
        self.stopwatch = Stopwatch()
        with settled(nodes=4) as self.tenancy:
            self.gaussians = GaussianField(settings.sh_degree, settings.max_gaussians)
            self.renderer = Renderer(self.gaussians, max_width, max_height, settings.image_cache)
            self.loss = self.renderer.loss
            self._last: LossValues | None = None
            self.adam = Adam(self.gaussians)
            self.safeguards = Safeguards()
            self.density = AdaptiveDensity(self.gaussians, settings, self.rng)
        self.trajectory = Trajectory()
        self.keyframes = KeyframeStore(trajectory=self.trajectory)

    def process(self, frame: TrackedFrame) -> FrameReport:
        self._refuse_held_out(frame)
        self.keyframes.append(frame)
        return FrameReport(frame.index, True, len(self.keyframes), 0, None)

    def correct(self, correction: PoseCorrection, more: bool = False) -> CorrectionReport:
        """Apply revised poses and points to the stored frames. The map is built later, so no Gaussians move."""
        return CorrectionReport(revise(self.keyframes, correction), moved=False)

    def initialise(self) -> None:
        """Create the initial Gaussians from the tracked points of all frames.

        Raises:
            ValueError: If there are too few points or no frame.
        """
        with self.stopwatch.measure("optimise"):
            points = union_of_points(self.keyframes)
            extent = scene_extent(self.keyframes)
            initialise(self.gaussians, points, self.settings.initial_opacity, LEAST_SIZE * extent)

    def optimise(self, progress: Callable[[int, int, float], None] | None = None) -> None:
        """Run all steps on an initialised map, and report each as (steps done, Gaussians, PSNR of its view)."""
        schedule, extent = Schedule.of(self.settings), scene_extent(self.keyframes)
        views: list[int] = []
        for step in range(1, schedule.steps + 1):
            with self.stopwatch.measure("optimise"):
                views = views or self.rng.permutation(len(self.keyframes)).tolist()
                rates = self._rates(extent * decay(step - 1, schedule.steps, self.settings.position_decay))
                psnr = self._step(self.keyframes[views.pop()], rates, schedule.sh_degree(step))
                if schedule.adapts_at(step):
                    self.density.adapt(extent, prune_large=step > schedule.reset_every)
                if schedule.resets_at(step):
                    self.density.reset_opacities()
            if progress is not None:
                progress(step, len(self.gaussians), psnr)

    def finish(self, progress: Callable[[int, int, float], None] | None = None) -> None:
        """Build the map from the stored frames.

        Args:
            progress: See `optimise`.

        Raises:
            NothingToMapError: If there are too few tracked points or no frame.
        """
        try:
            self.initialise()
        except ValueError as error:
            raise NothingToMapError(str(error)) from None
        self.optimise(progress)

    def _rates(self, position_unit: float) -> LearningRates:
        s = self.settings
        return LearningRates(
            position=s.position_rate * position_unit,
            log_scale=s.scale_rate,
            quaternion=s.rotation_rate,
            opacity_logit=s.opacity_rate,
            colour=s.colour_rate,
        )

    def _step(self, view: Keyframe, rates: LearningRates, sh_degree: int) -> float:
        """Make one Adam step on one view. Returns its PSNR before the step; on a GPU, that of the previous view."""
        renderer = self.renderer
        renderer.forward(view.camera, view.T_camera_world, self.near, exact=False)
        renderer.develop(None, view.vignette)
        values = self.loss.forward(view.rgba)
        self.loss.send()
        self.loss.backward(self.settings.ssim_weight)
        renderer.backward(observe=self.density.statistics.observe)
        self.adam.step(rates, sh_degree=sh_degree, largest=EXPLODED * self.keyframes.scene_depth)
        known = values if self.loss.lag == 0 or self._last is None else self._last
        self._last = values
        return known.psnr

    def compile(self) -> None:
        """Compile all kernels on a scene of four Gaussians, so that timings exclude it. The map must be empty."""
        camera = PinholeCamera(16.0, 16.0, 8.0, 8.0, 16, 16)
        with self.stopwatch.measure("compile"):
            image = np.full((16, 16, 3), 0.5, dtype=np.float32)
            xyz = np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, 0.1, 1.0], [0.1, 0.1, 1.0]])
            points = SparsePoints(xyz, camera.project(xyz), np.arange(4))
            store = KeyframeStore()
            view = store.append(TrackedFrame(0, 0.0, "compile", image, camera, np.eye(4), points))
            initialise(self.gaussians, union_of_points(store), self.settings.initial_opacity, LEAST_SIZE)
            self._step(view, self._rates(1.0), self.settings.sh_degree)
            self.density.reset_opacities()
            self.density.statistics.clear()
            self.renderer.images.clip_colour()
            self.renderer.images.colour_to_numpy()
            self.gaussians.take_caught()
            self.gaussians.to_numpy()
            self.gaussians.remove(np.zeros(4, dtype=bool))
            self.renderer.view_renders = 0
            self._last = None
