"""Warm-up: compiles the kernels of an online map before its first frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.keyframes import KeyframeStore
from pipelines.densify.growth import grow, tracked_seeds
from pipelines.render.formulas import IDENTITY

if TYPE_CHECKING:
    from pipelines.online import OnlineMapper


def warm_up(mapper: OnlineMapper) -> None:
    """Run every kernel of an empty map once, on two views of four Gaussians, and leave the map empty."""
    camera = PinholeCamera(16.0, 16.0, 8.0, 8.0, 16, 16)
    pixels = np.array([[4.0, 4.0], [12.0, 4.0], [4.0, 12.0], [12.0, 12.0]])
    points = SparsePoints(camera.unproject(pixels, np.ones(4)), pixels, np.arange(4))
    image = np.full((16, 16, 3), 0.5, dtype=np.float32)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.1
    settings, gaussians, optimiser, renderer = mapper.settings, mapper.gaussians, mapper.optimiser, mapper.renderer
    depth, voxels = mapper.densifier.depth, mapper.densifier.voxels
    with mapper.stopwatch.measure("compile"):
        store = KeyframeStore()
        first, view = (
            store.append(TrackedFrame(i, 0.0, "compile", image, camera, T, points)) for i, T in enumerate(poses)
        )
        if voxels is not None:
            voxels.query(np.zeros((0, 3)), 1.0)
            voxels.admit(np.zeros((0, 3)), 1.0)
        grow(gaussians, tracked_seeds(view), None, 1.0, settings.densify, mapper.budget)
        optimiser.exposure.new_keyframe(store, renderer, settings.near)
        if settings.exposure.enabled:
            first.exposure = view.exposure = np.array(IDENTITY)
            mapper.zero.motion.recolour(np.ones(3), np.zeros(3))
        optimiser.step(store, [1], optimiser.rates(1.0), pose_rate=1e-6 if settings.poses.enabled else 0.0)
        optimiser.settle()
        optimiser.exposure.moments.forget(view.index)
        optimiser.poses.moments.forget(view.index)
        depth.estimate(view, [first], pixels)
        mapper.hidden.contribution.begin()
        mapper.hidden.contribution.measure(store, settings.near)
        gaussians.coverages()
        renderer.images.clip_colour()
        renderer.images.colour_to_numpy()
        gaussians.to_numpy()
        gaussians.anchors()
        gaussians.take_caught()
        if settings.corrections.enabled:
            mapper.corrector.motion.move(np.eye(4)[None], np.eye(gaussians.sh_count)[None])
            if voxels is not None:
                voxels.clear()
        renderer.view_renders = 0
        gaussians.remove(np.arange(len(gaussians)) > 0)  # the last one moves to the first one's place
        gaussians.remove(np.zeros(len(gaussians), dtype=bool))
