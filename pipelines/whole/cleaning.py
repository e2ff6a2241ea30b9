"""Faults of a finished map: floaters, giants, needles, and what lies outside of all that the keyframes have seen."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.map.keyframe import Keyframe
from fields.map.keyframes import centres_of
from pipelines.companions.exposure import resized_vignette
from pipelines.online import OnlineMapper
from pipelines.whole.merge import BEFORE, COARSE, LEAST_OPACITY, FreeSpace

# Sum of alpha T from which a Gaussian shows in a view [px of the level].
SHOWS = 0.5
# A Gaussian is a suspect if it shows where the error of renders is this factor above the usual one, and this large at
# least [1 = white]; or if it shows in at most FEW of the views that have it in sight, of which there are MANY.
FACTOR, WRONG = 3.0, 0.03
FEW, MANY = 2, 5
LITTLE, SMOOTH = 1.5, 5
# Views that must see through the place of a suspect, and the share that they must be of those that see a surface there.
MIN_THROUGH, MAJORITY = 3, 0.8
# Standard deviation from which a Gaussian is a giant [scene depths], also relative to the distance of the nearest
# keyframe; and from which one that is NARROW times thinner in both other directions is a needle [scene depths].
GIANT, GIANT_ANGLE = 1.0, 0.5
NEEDLE, NARROW = 0.1, 20.0
# Reach from which holes of a depth image are filled [image widths], and the share of it that must be known.
HOLE, LEAST_KNOWN = 0.05, 0.05
# Rounds in which floaters are looked for, by factors on both errors above. The worst are removed first, since they
# make what lies behind them a suspect.
ROUNDS = (4.0, 2.0, 1.0, 1.0)


def faults(mapper: OnlineMapper) -> tuple[dict[str, NDArray[np.bool_]], NDArray[np.float64]]:
    """Find the faulty Gaussians of a finished map that is in memory as a whole.

    A floater is a suspect that stands in free space. What makes it a suspect is that keyframes are rendered wrongly
    where it shows, or that few of those that should show it do. Whether its place is free is asked of the map without
    all suspects: most keyframes that have the place in their image must see through it to a surface behind. In the map
    without the floaters that were found, more may be recognised.

    Args:
        mapper: The map. Its Gaussians are those without floaters afterwards, without anchors.

    Returns:
        Masks (N,) of `floaters`, `outside`, `giants` and `needles`, each Gaussian being of one kind at most, and how
        much each shows in all keyframes together (N,) [px].
    """
    state, depth = mapper.gaussians.to_numpy(), mapper.keyframes.scene_depth
    position, count = state["position"].astype(np.float64), len(state["position"])
    sizes = np.sort(np.exp(state["log_scale"].astype(np.float64)), axis=1) / depth
    floaters, outside, shows = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool), np.zeros(count)
    for strictness in ROUNDS:
        there = np.flatnonzero(~floaters)
        suspect, unseen, total = _suspects(mapper, position[there], strictness)
        outside[there[unseen]] = True
        shows[there] = total
        mapper.gaussians.load({name: values[there[~suspect]] for name, values in state.items()})
        found = there[suspect][_in_free_space(mapper, position[there[suspect]])]
        floaters[found] = True
        mapper.gaussians.load({name: values[~floaters] for name, values in state.items()})
        if len(found) == 0 and strictness == ROUNDS[-1]:
            break
    distance = np.full(count, np.inf)
    large = np.flatnonzero(sizes[:, 2] > GIANT)
    for centre in centres_of(list(mapper.keyframes)):
        distance[large] = np.minimum(distance[large], np.linalg.norm(position[large] - centre, axis=1))
    found = {
        "floaters": floaters,
        "outside": outside,
        "giants": (sizes[:, 2] > GIANT) & (sizes[:, 2] * depth > GIANT_ANGLE * distance),
        "needles": (sizes[:, 2] > NEEDLE) & (sizes[:, 2] > NARROW * sizes[:, 1]),
    }
    taken = np.zeros(count, dtype=bool)
    for kind in found:
        found[kind] = found[kind] & ~taken
        taken |= found[kind]
    return found, shows


def _suspects(
    mapper: OnlineMapper, position: NDArray[np.float64], strictness: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float64]]:
    """Return which of the loaded Gaussians (N,) are suspects, which no keyframe sees, and how much they show (N,)."""
    space = FreeSpace(mapper.renderer, mapper.near)
    total, error, relative = np.zeros((3, len(position)))
    shown, sight, inside = np.zeros((3, len(position)), dtype=np.int64)
    for view in mapper.keyframes:
        difference, depth, valid = _compared(mapper, view)
        camera = view.image(COARSE).camera
        smooth = cv2.medianBlur(depth.astype(np.float32), SMOOTH)
        inverse = np.where(smooth > 0, valid / np.maximum(smooth, mapper.near), valid / mapper.keyframes.scene_depth)
        index, z, (weight, wrong, weighted) = space.shown(camera, view.T_camera_world, valid, difference, inverse)
        total[index] += weight
        error[index] += wrong
        relative[index] += z * weighted
        shown[index] += weight >= SHOWS
        seen, z, surface = _looked_at(position, camera, view.T_camera_world, depth, mapper.near)
        inside[seen] += 1
        sight[seen] += (surface > 0) & (z < surface / BEFORE)
    ratio = error / np.maximum(total, 1e-9)
    usual = float(np.median(ratio[total > 0])) if (total > 0).any() else 0.0
    suspect = (total > 0) & (ratio >= strictness * max(FACTOR * usual, WRONG))
    if strictness > ROUNDS[-1]:
        return suspect, (inside == 0) & (shown == 0), total
    suspect |= (total > 0) & (ratio >= LITTLE * usual) & (relative < BEFORE * total)
    suspect |= (shown <= FEW) & (sight >= MANY)
    return suspect, (inside == 0) & (shown == 0), total


def harmless(
    found: dict[str, NDArray[np.bool_]],
    shows: NDArray[np.float64],
    score: Callable[[NDArray[np.bool_]], float],
    loss: float,
) -> tuple[dict[str, NDArray[np.bool_]], float, float]:
    """Take of the faulty Gaussians what costs less than a given quality, kind after kind.

    If all of a kind cost too much, the half of them that shows least is tried, then a quarter, and so on to 1/8.

    Args:
        found: Masks (N,) by kind.
        shows: How much each Gaussian shows (N,).
        score: Quality of the map with the Gaussians of a mask (N,) [dB].
        loss: Largest loss of quality [dB].

    Returns:
        Masks (N,) of what is taken by kind, and the quality before and after.
    """
    kept = np.ones(len(shows), dtype=bool)
    before = after = score(kept)
    taken = {}
    for kind, mask in found.items():
        order = np.flatnonzero(mask)[np.argsort(shows[mask], kind="stable")]
        taken[kind] = np.zeros_like(kept)
        for count in (-(-len(order) // part) for part in (1, 2, 4, 8) if len(order)):
            some = np.zeros_like(kept)
            some[order[:count]] = True
            quality = score(kept & ~some)
            if quality >= before - loss:
                taken[kind], kept, after = some, kept & ~some, quality
                break
    return taken, before, after


def _compared(mapper: OnlineMapper, view: Keyframe) -> tuple[NDArray, NDArray, NDArray]:
    """Return error, depth and validity (h, w) of the render of a keyframe at the coarse level."""
    image, renderer = view.image(COARSE), mapper.renderer
    renderer.forward(image.camera, view.T_camera_world, mapper.near)
    vignette = None if view.vignette is None else resized_vignette(view.vignette, image.rgba)
    renderer.develop(view.exposure, vignette)
    render = renderer.rendered()
    valid = (image.rgba[..., 3] > 0).astype(np.float32)
    difference = np.abs(np.clip(render.colour, 0.0, 1.0) - image.rgba[..., :3] / np.float32(255.0)).mean(axis=-1)
    return difference * valid, render.expected_depth(LEAST_OPACITY), valid


def _looked_at(
    position: NDArray[np.float64],
    camera: PinholeCamera,
    T_camera_world: NDArray[np.float64],
    depth: NDArray[np.floating],
    near: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.floating]]:
    """Return which positions (M,) lie in an image, their depths (M,), and the image's depths (M,) at their pixels."""
    there = position @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    seen = np.flatnonzero(there[:, 2] > near)
    pixels = camera.project(there[seen])
    inside = camera.contains(pixels)
    column, row = pixels[inside].astype(np.int64).T
    return seen[inside], there[seen[inside], 2], depth[row, column]


def _in_free_space(mapper: OnlineMapper, position: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which positions (S,) are in the free space of the loaded map, which is without what may be there."""
    through, on = np.zeros((2, len(position)), dtype=np.int64)
    for view in mapper.keyframes:
        camera = view.image(COARSE).camera
        mapper.renderer.forward(camera, view.T_camera_world, mapper.near)
        depth = _filled(mapper.renderer.rendered().expected_depth(LEAST_OPACITY))
        seen, z, surface = _looked_at(position, camera, view.T_camera_world, depth, mapper.near)
        through[seen] += (surface > 0) & (z < BEFORE * surface)
        on[seen] += (surface > 0) & (z >= BEFORE * surface) & (z < surface / BEFORE)
    return (through >= MIN_THROUGH) & (through >= MAJORITY * (through + on))


def _filled(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    """Fill the holes of a depth image (H, W), which suspects have left, with the mean of what is around them."""
    depth = depth.astype(np.float32)
    known = (depth > 0).astype(np.float32)
    sigma = HOLE * depth.shape[1]
    share = np.asarray(cv2.GaussianBlur(known, (0, 0), sigma))
    around = np.asarray(cv2.GaussianBlur(depth, (0, 0), sigma)) / np.maximum(share, np.float32(1e-6))
    return np.where(known > 0, depth, np.where(share > LEAST_KNOWN, around, np.float32(0.0)))
