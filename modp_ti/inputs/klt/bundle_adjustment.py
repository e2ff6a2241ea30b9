"""Bundle adjustment of a map's keyframes, some of them fixed."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from modp_ti.inputs.klt.landmark_map import LandmarkMap
from modp_ti.inputs.klt.lens import Lens
from modp_ti.inputs.multiview.bundle_adjustment import Refinable, adjusted_bundle

__all__ = ["adjust_bundle"]


def adjust_bundle(
    landmarks: LandmarkMap,
    free: Sequence[int],
    held: Sequence[int] = (),
    steps: int = 10,
    refined: Collection[Refinable] = (),
) -> float:
    """Minimise the robust reprojection error over keyframes and the landmarks that they see, in place.

    Args:
        landmarks: The map.
        free: Keyframes whose poses are optimised.
        held: Keyframes that take part with fixed poses. Without any, the first two of `free` fix the gauge.
        steps: Levenberg-Marquardt steps at most.
        refined: Parts of the camera that are optimised too.

    Returns:
        The mean cost per observation [px^2 / 2]; infinite if there are too few observations.
    """
    views = sorted({*free, *held})
    of, ids, pixels = landmarks.observations(views)
    free_mask = np.zeros(len(landmarks.keyframes), dtype=bool)
    free_mask[list(free)] = True
    wanted = np.zeros(len(landmarks.known), dtype=bool)
    wanted[ids[free_mask[of]]] = True
    used = wanted[ids] & (np.bincount(ids, minlength=len(wanted))[ids] >= 2)
    of, ids, pixels = of[used], ids[used], pixels[used]
    if len(ids) < 12:
        return float("inf")
    poses = {k: landmarks.keyframes[k].T_camera_world for k in views}
    bundle = adjusted_bundle(
        landmarks.lens.camera, poses, of, ids, pixels, landmarks.xyz, set(free), steps, refined=refined
    )
    if bundle is None:
        return float("inf")
    for k, T in bundle.poses.items():
        landmarks.keyframes[k].T_camera_world[:3] = T[:3]
    landmarks.xyz[bundle.points] = bundle.xyz
    if refined:
        landmarks.use_lens(Lens(bundle.camera))
    return bundle.cost
