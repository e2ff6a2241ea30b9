"""Optimisation steps of the map: render a batch of views, compare, differentiate, and update Gaussians and poses."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from fields.map.gaussians import GaussianField
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.companions.companion import Companion
from pipelines.companions.exposure import ExposureRefinement
from pipelines.optimise.adam import Adam, AspectPenalty, LearningRates
from pipelines.optimise.cameras import make_cameras
from pipelines.optimise.measured_depth import MeasuredDepthLoss
from pipelines.optimise.poses import PoseRefinement
from pipelines.render.formulas import LossValues
from pipelines.render.renderer import Renderer
from pipelines.safeguards import EXPLODED, Safeguards
from pipelines.settings import MappingSettings


class MapOptimiser:
    """Optimises Gaussians, and the poses and exposures of keyframes, on the images of keyframes.

    Args:
        gaussians: The Gaussians of the map.
        renderer: Renderer of the map.
        settings: Settings of the mapping.
        companions: What is called before steps, views and updates, in order.
    """

    def __init__(
        self,
        gaussians: GaussianField,
        renderer: Renderer,
        settings: MappingSettings,
        companions: Sequence[Companion] = (),
    ) -> None:
        self.gaussians = gaussians
        self.renderer = renderer
        self.settings = settings
        self.loss = renderer.loss
        self.measured = MeasuredDepthLoss(renderer.images, settings.optimise.depth_weight)
        self.aspect = AspectPenalty(gaussians)
        self.adam = Adam(gaussians)
        self.safeguards = Safeguards()
        self.poses = PoseRefinement(self.safeguards)
        self.exposure = ExposureRefinement(settings.exposure, self.safeguards)
        self.cameras = make_cameras(renderer, self.poses, self.exposure)
        # Loss values of views that have not been read yet, with the level of each step. Empty between steps on the CPU.
        self._unread: deque[tuple[list[tuple[Keyframe, LossValues]], int]] = deque()
        self._psnr = float("nan")
        self.companions = companions

    def rates(
        self, scene_depth: float, position_factor: float = 1.0, scale_factor: float = 1.0, other_factor: float = 1.0
    ) -> LearningRates:
        """Return the learning rates of the settings, with positions in scene units.

        Args:
            scene_depth: Depth of the scene [scene units].
            position_factor: Factor on the position rate.
            scale_factor: Factor on the scale rate.
            other_factor: Factor on the rates of rotation, opacity and colour.
        """
        o = self.settings.optimise
        return LearningRates(
            position=o.position_rate * scene_depth * position_factor,
            log_scale=o.scale_rate * scale_factor,
            quaternion=o.rotation_rate * other_factor,
            opacity_logit=o.opacity_rate * other_factor,
            colour=o.colour_rate * other_factor,
        )

    def compare(self, view: Keyframe, scene_depth: float, level: int = 0, exact: bool = True) -> LossValues:
        """Render a keyframe, apply exposure and vignette, and evaluate the loss against its image.

        Args:
            view: The keyframe.
            scene_depth: Depth of the scene [scene units].
            level: Pyramid level of the image.
            exact: See `Renderer.forward`.

        Returns:
            Values of the loss.
        """
        image = view.image(level)
        self.cameras.render(view, image, self.settings.near * scene_depth, exact)
        return self.loss.forward(image.rgba)

    def step(
        self, store: KeyframeStore, views: list[int], rates: LearningRates, pose_rate: float, level: int = 0
    ) -> float:
        """Make Adam steps on the views, one for each batch.

        Updates the Gaussians, the errors of the keyframes, their poses and, where estimated, their exposures. The pose
        of the first keyframe is fixed, and pose and exposure of the first one of each further place. On a GPU, the host
        does not wait for the device: errors and PSNR lag by one step (NaN at first), and poses and exposures stay on
        the device. `settle` applies all pending results.

        Args:
            store: The keyframes.
            views: Indices into `store`.
            rates: Learning rates of the Gaussians.
            pose_rate: Step of the poses [px]; 0 to keep them.
            level: Pyramid level of the images.

        Returns:
            Mean PSNR of the views.
        """
        for companion in self.companions:
            companion.before_step()
        size = self.settings.optimise.batch
        seen: list[tuple[Keyframe, LossValues]] = []
        for first in range(0, len(views), size):
            batch = [store[j] for j in views[first : first + size]]
            for companion in self.companions:
                companion.before_views(batch)
            seen += self._step(store, views[first : first + size], rates, pose_rate, level)
        self.loss.send()
        self._unread.append((seen, level))
        while len(self._unread) > self.loss.lag:
            self._read(*self._unread.popleft())
        return self._psnr

    def settle(self) -> float:
        """Apply all pending results of the steps so far. Waits for the device.

        Returns:
            Mean PSNR of the last step's views.
        """
        while self._unread:
            self._read(*self._unread.popleft())
        self.cameras.settle()
        return self._psnr

    def _read(self, seen: list[tuple[Keyframe, LossValues]], level: int) -> None:
        """Apply the loss values of a step's views at a pyramid level."""
        sound = [(view, values) for view, values in seen if np.isfinite(values.l1)]
        self.safeguards.views += len(seen) - len(sound)
        for view, values in sound:
            view.note_error(values.l1, level)
        if sound:
            self._psnr = float(np.mean([values.psnr for _, values in sound]))

    def _step(
        self, store: KeyframeStore, views: list[int], rates: LearningRates, pose_rate: float, level: int
    ) -> list[tuple[Keyframe, LossValues]]:
        o = self.settings.optimise
        seen: list[tuple[Keyframe, LossValues]] = []
        for k, j in enumerate(views):
            view, is_last = store[j], j not in views[k + 1 :]
            values = self.compare(view, store.scene_depth, level, exact=False)
            self.loss.backward(o.ssim_weight, 1.0 / len(views))
            measured = self.measured.backward(view, view.image(level).camera, 1.0 / len(views))
            self.renderer.backward(with_depth=measured)
            self.measured.clear()
            seen.append((view, values))
            if pose_rate > 0 and j > 0 and view.index not in store.begins:
                self.cameras.step_pose(view, pose_rate, is_last)
            if view.exposure is not None and view.index not in store.begins:
                self.cameras.step_exposure(view, views.count(j) / len(views), is_last)
        self.aspect.backward(o.aspect_weight, store.scene_depth)
        rendered = [view for view, _ in seen]
        for companion in self.companions:
            companion.before_update(rendered)
        self.adam.step(rates, len(views), largest=EXPLODED * store.scene_depth)
        self.cameras.move()
        return seen
