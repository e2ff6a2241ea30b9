"""The online mapping loop: track, add, filter, select views, optimise (the paper's overview figure)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from fields.geometry.similarity import moved_points, scale_of
from fields.map.gaussian_motion import GaussianMotion
from fields.map.gaussians import GaussianField
from fields.map.keyframe_state import KeyframeRows, keyframe_arrays
from fields.map.keyframes import NO_MOTION, Keyframe, KeyframeStore
from fields.map.occupancy import OccupancyVoxels
from pipelines.corrections import CorrectionReport, pending_motion_in_pixels, revise
from pipelines.densify.contribution import Contribution
from pipelines.densify.depth import DepthEstimator, build_depth
from pipelines.densify.growth import dissimilarity, error_pixels, grow, pixel_seeds, tracked_seeds
from pipelines.memory_budget import MemoryBudget
from pipelines.optimise.map_optimiser import MapOptimiser
from pipelines.optimise.safeguards import Safeguards
from pipelines.pipeline import FrameReport, Pipeline
from pipelines.refinement import refine
from pipelines.render.renderer import Renderer
from pipelines.render.spherical_harmonics import sh_rotation
from pipelines.select.frame_gate import FrameGate
from pipelines.select.keyframes import KeyframeSelector
from pipelines.select.views import LocalGlobalViews, ViewSelection, global_probabilities
from pipelines.settings import MappingSettings, RefineSettings
from pipelines.state import MapState
from pipelines.stopwatch import Stopwatch

__all__ = ["OnlineMapper"]

# A pixel whose rendered opacity is below this counts as a hole.
HOLE = 0.5


@dataclass(slots=True)
class Anchor:
    """A view that placed Gaussians.

    Attributes:
        keyframe: Keyframe that these Gaussians move with.
        spacing: Target voxel size that the view asked for [scene units].
    """

    keyframe: Keyframe
    spacing: float


class OnlineMapper(Pipeline):
    """Builds a Gaussian map from a stream of `TrackedFrame`s.

    Each Gaussian stores the view that placed it (`GaussianField.anchor`, an index into `anchors`). When the tracker
    corrects the pose of that view, the Gaussian moves with it.

    Args:
        settings: Settings of the mapping.
        max_width: Largest image width [px].
        max_height: Largest image height [px].
        seed: Seed of the random generator.
        depth: Depth estimator; None builds the one that `settings.depth` names.
        views: View selection; None for `LocalGlobalViews`.
    """

    can_be_refined: ClassVar[bool] = True

    def __init__(
        self,
        settings: MappingSettings,
        max_width: int,
        max_height: int,
        seed: int = 0,
        depth: DepthEstimator | None = None,
        views: ViewSelection | None = None,
    ) -> None:
        self.settings = settings
        self.rng = np.random.default_rng(seed)
        self.stopwatch = Stopwatch()
        self.gaussians = GaussianField(settings.sh_degree, settings.max_gaussians)
        self.renderer = Renderer(self.gaussians, max_width, max_height, settings.image_cache)
        self.optimiser = MapOptimiser(self.gaussians, self.renderer, settings)
        self.loss = self.optimiser.loss
        self.contribution = Contribution(self.gaussians, self.renderer)
        self.keyframes = KeyframeStore(len(settings.levels.probabilities), settings.levels.min_side)
        v = settings.voxels
        self.voxels = OccupancyVoxels(levels=v.levels, resolution=v.resolution) if v.enabled else None
        self.gate = FrameGate(settings.gate)
        self.selector = KeyframeSelector(settings.keyframes)
        self.depth = depth or build_depth(settings.depth, self.renderer, settings.near, self.rng)
        self.views = views or LocalGlobalViews(settings.views, self.rng)
        limit = None if settings.memory is None else settings.memory * 1e9
        self.budget = MemoryBudget(limit, self.gaussians, self.keyframes, self.voxels, self.optimiser.safeguards)
        self.motion = GaussianMotion(self.gaussians)
        self.anchors: list[Anchor] = []
        self._tracked: dict[int, NDArray[np.float64]] = {}  # T_camera_world from the tracker, by frame index
        self._frames = 0

    @property
    def near(self) -> float:
        """Depth [scene units] below which nothing is drawn."""
        return self.settings.near * self.keyframes.scene_depth

    # ---- the loop --------------------------------------------------------------------------------------------

    def process(self, frame: TrackedFrame) -> FrameReport:
        """Process the next frame.

        Raises:
            ValueError: If the frame is held out for evaluation.
        """
        if frame.held_out:
            raise ValueError(f"frame {frame.index} is held out for evaluation and must not touch the map")
        self._frames += 1
        self._tracked[frame.index] = frame.T_camera_world
        if self._frames % self.settings.densify.prune_every == 0:
            self.prune()
        with self.stopwatch.measure("select"):
            last = self.keyframes[-1] if len(self.keyframes) else None
            if self.gate.refuses(frame, last, self.renderer, self.near):
                return FrameReport(frame.index, False, len(self.keyframes), len(self.gaussians), None)
            is_wanted = self.selector.is_keyframe(frame, last)
            is_keyframe = is_wanted and self.budget.takes_keyframe(frame)
        psnr = None
        if is_keyframe:
            view = self.keyframes.append(frame)
            if len(self.keyframes) > 1 and self.settings.poses.enabled and self.settings.poses.align:
                self.optimiser.poses.align(view)
            with self.stopwatch.measure("optimise"):
                self.optimiser.exposure.begin(view, self.renderer, self.near)
            level = self._draw_level(view)
            self._add(view.at_level(level), compensate=self.settings.densify.error_compensation)
            psnr = self.optimise(self.settings.optimise.steps, level)
        elif len(self.keyframes):
            # Other frames only add their tracked points, at a pose corrected by the neighbouring keyframes.
            self._add(self.keyframes.view(frame), compensate=False)
            if is_wanted:
                # The budget has no room for this keyframe, so the existing ones are optimised instead. Far from them,
                # every frame asks to be a keyframe; each therefore gets only 1 / max_gap of the steps.
                steps = -(-self.settings.optimise.steps // self.settings.keyframes.max_gap)
                count = 1 + self.settings.views.local_views + self.settings.views.global_views
                psnr = self._optimise_evenly(np.arange(len(self.keyframes)), steps, count)
        return FrameReport(frame.index, is_keyframe, len(self.keyframes), len(self.gaussians), psnr)

    def correct(self, correction: PoseCorrection) -> CorrectionReport:
        """Apply poses and points that the tracker has revised.

        Keyframe poses change at once. Gaussians move with the views that placed them as soon as a keyframe's image
        would otherwise be displaced by more than `corrections.min_pixels`. The voxels are then marked again, and
        `corrections.steps` optimisation steps on the keyframes that moved remove the seams.
        """
        settings = self.settings.corrections
        with self.stopwatch.measure("correct"):
            self.optimiser.settle()
            motion = revise(self.keyframes, self._tracked, correction)
            self._tracked = {index: motion.of(index, T)[0] for index, T in self._tracked.items()}
            self.selector.correct(motion)
            self.gate.correct(motion)
            pending = np.array([pending_motion_in_pixels(view) for view in self.keyframes])
            if not (settings.enabled and (pending > settings.min_pixels).any()):
                return CorrectionReport(motion, moved=False)
            self._follow()
        self._optimise_evenly(np.flatnonzero(pending > 0), settings.steps, settings.views)
        return CorrectionReport(motion, moved=True)

    def _follow(self) -> None:
        """Move the Gaussians by the pending motion of their anchors, and mark the voxels again."""
        first = self.keyframes[0].pending_motion
        turns = {
            view.index: sh_rotation(
                self.gaussians.sh_degree, view.pending_motion[:3, :3] / scale_of(view.pending_motion)
            )
            for view in self.keyframes
        }
        if self.anchors:
            S = np.stack([anchor.keyframe.pending_motion for anchor in self.anchors])
            self.motion.move(S, np.stack([turns[anchor.keyframe.index] for anchor in self.anchors]))
        for anchor in self.anchors:
            anchor.spacing *= float(scale_of(anchor.keyframe.pending_motion))
        if self.voxels is not None:
            origin = moved_points(first, self.voxels.origin[None])[0]
            self.voxels.clear()
            self.voxels.settle(self.voxels.coarsest * float(scale_of(first)), origin)
            self._mark()
        for view in self.keyframes:
            view.pending_motion = NO_MOTION

    def _mark(self) -> None:
        """Mark the voxels of all Gaussians, each down to the level of its anchor's spacing."""
        anchor = self.gaussians.anchors()
        spacing = np.array([a.spacing for a in self.anchors] + [self.voxels.coarsest])[anchor]  # -1: the coarsest
        position = self.gaussians.to_numpy()["position"]
        order = np.argsort(spacing, kind="stable")  # on a GPU, `update` runs once per run of equal levels
        self.voxels.update(position[order], spacing[order])

    def _optimise_evenly(self, among: NDArray[np.int64], steps: int, views: int) -> float | None:
        """Optimise the map, but no poses, on `views` keyframes per step, drawn from `among` (N,) by error alone.

        Returns the mean PSNR of the last step.
        """
        if len(self.gaussians) == 0:
            return None
        with self.stopwatch.measure("optimise"):
            for _ in range(steps):
                p = global_probabilities(self.keyframes, self.settings.views.error_weight, 0.0)[among]
                batch = [int(j) for j in self.rng.choice(among, views, p=p / p.sum())]
                rates = self.optimiser.rates(self.keyframes.scene_depth)
                self.optimiser.step(self.keyframes, batch, rates, pose_rate=0.0)
            return self.optimiser.settle() if steps > 0 else None

    def finish(self, progress: Callable[[int, int, float], None] | None = None) -> float | None:
        """Finish the map after the last frame: further steps on the last keyframe, then a final pruning.

        Args:
            progress: Not called by the online loop.

        Returns:
            Mean PSNR of the last step; None if nothing was optimised.
        """
        psnr = self.optimise(self.settings.optimise.last_steps - self.settings.optimise.steps)
        self.prune()
        return psnr

    def _draw_level(self, view: Keyframe) -> int:
        """Draw the pyramid level of a new keyframe from the levels that its image has."""
        p = np.array(self.settings.levels.probabilities[: len(view.pyramid)])
        return int(self.rng.choice(len(p), p=p / p.sum()))

    def optimise(self, steps: int, level: int = 0) -> float | None:
        """Optimise the map on the last keyframe and the views selected with it.

        Args:
            steps: Number of optimisation steps.
            level: Pyramid level of the images.

        Returns:
            Mean PSNR of the last step; None if nothing was optimised.
        """
        if len(self.keyframes) == 0 or len(self.gaussians) == 0:
            return None
        poses = self.settings.poses
        with self.stopwatch.measure("select"):
            self.views.begin(self.keyframes)
        for step in range(steps):
            with self.stopwatch.measure("select"):
                views = self.views.select(self.keyframes)
            with self.stopwatch.measure("optimise"):
                self.optimiser.step(
                    self.keyframes,
                    views,
                    self.optimiser.rates(self.keyframes.scene_depth),
                    pose_rate=poses.learning_rate if poses.enabled and step < poses.steps else 0.0,
                    level=level,
                )
        with self.stopwatch.measure("optimise"):
            return self.optimiser.settle() if steps > 0 else None

    def prune(self) -> int:
        """Remove Gaussians whose opacity is below `densify.prune_opacity`.

        Returns:
            Number of Gaussians removed.
        """
        return self.gaussians.remove(self.gaussians.opacities() >= self.settings.densify.prune_opacity)

    # ---- adding Gaussians ------------------------------------------------------------------------------------

    def _add(self, view: Keyframe, compensate: bool) -> None:
        """Densify from one view: tracked points, then high-error pixels, both filtered by the voxels."""
        self.anchors.append(Anchor(self.keyframes[-1], self.settings.voxels.target * view.view_scale))
        self._grow(tracked_seeds(view), view)
        if not compensate:
            return
        with self.stopwatch.measure("depth"):
            self.optimiser.compare(view, self.keyframes.scene_depth)
            images = self.renderer.images
            warming_up = self._frames <= self.settings.densify.warm_up
            error = None if warming_up else dissimilarity(images.colour_to_numpy(), view.rgba)
            opacity = images.opacity_to_numpy()
            pixels = error_pixels(view, error, self.settings.densify, self.rng)
            column, row = np.floor(pixels).astype(int).T
            depth = self.settings.depth
            limit = np.where(opacity[row, column] < HOLE, depth.hole_deviation, depth.max_deviation)
            last = len(self.keyframes) - 1  # that of `view`
            neighbours = [self.keyframes[j] for j in range(max(0, last - depth.neighbours), last)]
            seeds = pixel_seeds(view, neighbours, pixels, self.depth, limit)
        self._grow(seeds, view)

    def _grow(self, seeds, view: Keyframe) -> None:
        with self.stopwatch.measure("occupancy"):
            v = self.settings.voxels
            if self.voxels is not None and len(self.gaussians) == 0:
                centre = inverse_se3(view.T_camera_world)[:3, 3]
                self.voxels.settle(v.coarsest * view.view_scale, centre)
            spacing = self.anchors[-1].spacing
            grow(self.gaussians, seeds, self.voxels, spacing, self.settings.densify, self.budget, len(self.anchors) - 1)

    def refine(
        self, settings: RefineSettings, progress: Callable[[int, float], None] | None = None, done: int = 0
    ) -> None:
        refine(self, settings, progress, done)

    # ---- safeguards and budget -------------------------------------------------------------------------------

    def caught(self) -> Safeguards:
        """Return the safeguards' counts so far. Waits for the device."""
        return self.optimiser.caught()

    @property
    def refused(self) -> Mapping[str, int]:
        return self.gate.refused

    def takes_observations(self, count: int) -> bool:
        return self.budget.takes_observations(count)

    def count_beside(self, nbytes: int) -> None:
        self.budget.beside = nbytes

    # ---- snapshots -------------------------------------------------------------------------------------------

    def state(self) -> MapState:
        """Return everything that the next frame or step depends on, except the keyframes' images.

        Call it between two steps.
        """
        self.optimiser.settle()
        groups = {
            "gaussians": self.gaussians.to_numpy() | self.gaussians.history(),
            "keyframes": keyframe_arrays(self.keyframes),
            "tracked": {
                "index": np.array(list(self._tracked), dtype=np.int64),
                "T": np.array(list(self._tracked.values())).reshape(-1, 4, 4),
            },
        }
        place = {view.index: row for row, view in enumerate(self.keyframes)}
        groups["anchors"] = {
            "keyframe": np.array([place[anchor.keyframe.index] for anchor in self.anchors], dtype=np.int64),
            "spacing": np.array([anchor.spacing for anchor in self.anchors]),
        }
        numbers: dict[str, Any] = {
            "frames": self._frames,
            "view_renders": self.renderer.view_renders,
            "random": self.rng.bit_generator.state,
            "gate": self.gate.state(),
            "guards": self.optimiser.caught().counts(),
        }
        if self.voxels is not None:
            places, words = self.voxels.marks()
            groups["voxels"] = {"places": places, "words": words}
            numbers |= {"coarsest": self.voxels.coarsest, "origin": self.voxels.origin.tolist()}
        if self.selector.previous is not None:
            index, T = self.selector.previous
            groups["previous"] = {"index": np.array(index), "T": T}
        return MapState.of(groups, numbers)

    def restore(self, state: MapState, frames: Iterable[TrackedFrame]) -> None:
        """Restore a saved state into a new mapper with the same settings.

        Args:
            state: Result of `state`.
            frames: The frames that the saved mapper had processed, without held-out ones. The keyframes take their
                images from them.

        Raises:
            KeyError, TypeError, ValueError: If the state does not fit. The mapper is then unusable.
        """
        rows = KeyframeRows(state.group("keyframes"))
        for frame in frames:
            if frame.index in rows.rows:
                rows.put(frame, self.keyframes)
        if len(self.keyframes) != len(rows.rows):
            raise ValueError(f"{len(self.keyframes)} of the {len(rows.rows)} keyframes are among the frames")
        self.keyframes.take_in_depths()
        self.gaussians.restore(state.group("gaussians"))
        anchors = state.group("anchors")
        pairs = zip(anchors["keyframe"].tolist(), anchors["spacing"].tolist(), strict=True)
        self.anchors = [Anchor(self.keyframes[row], spacing) for row, spacing in pairs]
        if len(self.gaussians) and self.gaussians.anchors().max() >= len(self.anchors):
            raise ValueError("Gaussians have anchors that there are not")
        tracked = state.group("tracked")
        self._tracked = dict(zip(tracked["index"].tolist(), list(tracked["T"]), strict=True))
        if self.voxels is not None:
            self.voxels.settle(state.numbers["coarsest"], state.numbers["origin"])
            self.voxels.restore(**state.group("voxels"))
        previous = state.group("previous")
        self.selector.previous = (int(previous["index"]), previous["T"]) if previous else None
        self._frames = int(state.numbers["frames"])
        self.renderer.view_renders = int(state.numbers["view_renders"])
        self.rng.bit_generator.state = state.numbers["random"]
        self.gate.restore(state.numbers["gate"])
        self.optimiser.safeguards.restore(state.numbers["guards"])

    # ---- compiling -------------------------------------------------------------------------------------------

    def compile(self) -> None:
        """Compile all kernels ahead of the first frame, on two views of four Gaussians. The map must be empty."""
        camera = PinholeCamera(16.0, 16.0, 8.0, 8.0, 16, 16)
        pixels = np.array([[4.0, 4.0], [12.0, 4.0], [4.0, 12.0], [12.0, 12.0]])
        points = SparsePoints(camera.unproject(pixels, np.ones(4)), pixels, np.arange(4))
        image = np.full((16, 16, 3), 0.5, dtype=np.float32)
        with self.stopwatch.measure("compile"):
            store = KeyframeStore()
            for i in range(2):
                T = np.eye(4)
                T[0, 3] = 0.1 * i
                view = store.append(TrackedFrame(i, 0.0, "compile", image, camera, T, points))
            if self.voxels is not None:
                self.voxels.query(np.zeros((0, 3)), 1.0)
                self.voxels.admit(np.zeros((0, 3)), 1.0)
            grow(self.gaussians, tracked_seeds(view), None, 1.0, self.settings.densify, self.budget)
            self.optimiser.exposure.begin(view, self.renderer, self.settings.near)
            self.optimiser.step(store, [0], self.optimiser.rates(1.0), pose_rate=0.0)
            self.optimiser.settle()
            self.depth.estimate(view, [store[0]], pixels)
            self.contribution.measure(store, self.settings.near)
            self.renderer.camera_gradient()
            self.renderer.images.clip_colour()
            self.renderer.images.colour_to_numpy()
            self.gaussians.to_numpy()
            self.gaussians.anchors()
            self.gaussians.take_caught()
            if self.settings.corrections.enabled:
                self.motion.move(np.eye(4)[None], np.eye(self.gaussians.sh_count)[None])
                if self.voxels is not None:
                    self.voxels.clear()
            self.renderer.view_renders = 0
            self.gaussians.remove(np.zeros(len(self.gaussians), dtype=bool))
