"""`ViewAlignment`: refines the pose of a view against a fixed map, by the gradient of the rendering loss."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.keyframes import KeyframeStore
from fields.runtime.tenancy import in_engine
from pipelines.optimise.exposure import MIN_OPACITY, MIN_PIXELS, fitted_gains
from pipelines.optimise.gpu_losses import photometric_loss
from pipelines.optimise.pose_refinement import PoseRefinement
from pipelines.render.renderer import Renderer

STEPS = 40
# Step lengths of the first and the last step [px]; they decay geometrically.
FIRST, LAST = 0.3, 0.02
SSIM_WEIGHT = 0.2
# Steps after which the exposure is fitted again, since a better pose gives better gains.
REFIT = 10


@in_engine("refine")
class ViewAlignment:
    """Refines the pose of a view so that the render of a fixed map resembles its image.

    The pose moves in the tangent of SE(3), see `PoseRefinement`. The exposure of the image is fitted as a gain per
    channel. Pixels where the map is not opaque do not count.

    Args:
        renderer: Renderer of the map. The gradients of its Gaussians are overwritten.
        near: Depth below which nothing is drawn [scene units].
    """

    def __init__(self, renderer: Renderer, near: float) -> None:
        self.renderer = renderer
        self.tenancy = renderer.tenancy
        self.near = near
        self.loss = photometric_loss(renderer.images)

    def refine(
        self,
        image: NDArray[np.float32],
        valid: NDArray[np.bool_] | None,
        camera: PinholeCamera,
        T_camera_world: NDArray[np.float64],
        points: SparsePoints,
    ) -> NDArray[np.float64]:
        """Refine a pose.

        Args:
            image: Undistorted image (H, W, 3) in [0, 1].
            valid: Valid pixels (H, W); None for all.
            camera: Camera of the image.
            T_camera_world: Initial pose (4, 4), at most a few pixels off.
            points: Points that the view sees, for their depth.

        Returns:
            T_camera_world (4, 4).
        """
        frame = TrackedFrame(0, 0.0, "view", image, camera, T_camera_world, points, mask=valid)
        view, poses = KeyframeStore().append(frame), PoseRefinement()
        rgba, gains = frame.rgba, np.ones(3)
        for step in range(STEPS):
            self.renderer.forward(camera, view.T_camera_world, self.near)
            if step % REFIT == 0:
                known = (self.renderer.images.opacity_to_numpy() > MIN_OPACITY) & (frame.rgba[..., 3] > 0)
                if known.sum() < MIN_PIXELS:
                    break
                gains = fitted_gains(self.renderer.images.colour_to_numpy()[known], image[known], gains)
                rgba = np.dstack([frame.rgba[..., :3], known * np.uint8(255)])
            self.renderer.develop(np.column_stack([np.diag(gains), np.zeros(3)]), None)
            self.renderer.images.set_reference(rgba)
            self.loss.forward()
            self.loss.backward(SSIM_WEIGHT)
            self.renderer.backward()
            rate = FIRST * (LAST / FIRST) ** (step / (STEPS - 1))
            poses.step(view, self.renderer.camera_gradient(), rate)
        self.renderer.gaussians.clear_gradients()
        return view.T_camera_world
