"""Features lie on their pixels, match where geometry allows, and are joined over the views, the clearest first."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from modp_ti.inputs.multiview.features import (
    Matches,
    detect_features,
    essential_matrix,
    feature_tracks,
    match_features,
)
from modp_ti.inputs.multiview.triangulation import neighbouring_views


def test_views_are_paired_in_growing_gaps_and_with_those_that_come_back():
    T = np.tile(np.eye(4), (40, 1, 1))
    T[:, 0, 3] = -np.r_[np.arange(20), np.arange(20)[::-1] + 0.25]  # there and back
    pairs = neighbouring_views(T)
    assert {(0, 1), (0, 2), (0, 3), (0, 5)} <= set(pairs)
    assert (2, 37) in pairs, "frame 37 is back at the place of frame 2"
    assert all(a < b for a, b in pairs) and len(set(pairs)) == len(pairs)
    T[20:, :3, :3] = np.diag([-1, 1, -1])  # looking away on the way back
    assert not any(a < 20 <= b for a, b in neighbouring_views(T))


def test_features_match_only_where_geometry_allows(plane_scene):
    images = [np.array(Image.open(plane_scene.folder / name)) for name in plane_scene.names[:2]]
    a, b = (detect_features(image) for image in images)
    K_inverse = np.linalg.inv(plane_scene.K)
    rays_a, rays_b = ((np.c_[f.pixels, np.ones(len(f.pixels))] @ K_inverse.T)[:, :2] for f in (a, b))
    T = plane_scene.T_camera_world
    E = essential_matrix(T[0], T[1])
    found = match_features(a.descriptors, b.descriptors, rays_a, rays_b, E, band=2 / 300)[0]
    assert len(found) > 100
    assert len(np.unique(found[:, 0])) == len(np.unique(found[:, 1])) == len(found)
    # oracle: the homography of the plane z = 0
    H = plane_scene.K @ T[1][:3, [0, 1, 3]] @ np.linalg.inv(plane_scene.K @ T[0][:3, [0, 1, 3]])
    moved = np.c_[a.pixels[found[:, 0]], np.ones(len(found))] @ H.T
    error = np.linalg.norm(moved[:, :2] / moved[:, 2:] - b.pixels[found[:, 1]], axis=1)
    assert np.median(error) < 0.3, "pixel centres are at +0.5 in both"
    assert (error < 2).mean() > 0.95
    unrelated, _ = match_features(a.descriptors, b.descriptors, rays_a, rays_b, E + 0.3, band=2 / 300)
    assert len(unrelated) < 0.3 * len(found)
    assert len(match_features(a.descriptors[:1], b.descriptors, rays_a[:1], rays_b, E, 1.0)[0]) == 0
    nowhere = np.full_like(rays_a, np.nan)
    assert len(match_features(a.descriptors, a.descriptors, nowhere, nowhere, np.eye(3), 1.0)[0]) == 0


# The second is searched at a smaller size.
@pytest.mark.parametrize("size", [(300, 260), pytest.param((2400, 2080), marks=pytest.mark.slow)])
def test_features_lie_at_the_centres_of_blobs(size):
    width, height = size
    spread = width / 100
    centres = np.random.default_rng(0).uniform(0.1, 0.9, (40, 2)) * size
    y, x = np.mgrid[:height, :width] + 0.5
    image = np.full((height, width), 30.0)
    for cx, cy in centres:
        image += 150 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * spread**2))
    found = detect_features(np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, axis=2)).pixels
    offset = found[:, None] - centres
    nearest = np.linalg.norm(offset, axis=2).argmin(axis=1)
    offset = offset[np.arange(len(found)), nearest]
    close = np.linalg.norm(offset, axis=1) < spread / 2
    assert close.sum() > 40
    assert np.abs(np.median(offset[close], axis=0)).max() < 0.05 * max(1, width / 1000)
    none = detect_features(np.full((50, 60, 3), 128, np.uint8))
    assert none.pixels.shape == (0, 2) and none.descriptors.shape == (0, 128)


def matches(a: int, b: int, *found: tuple[int, int, float]) -> tuple[int, int, Matches]:
    pairs = np.array([each[:2] for each in found], dtype=np.int64).reshape(-1, 2)
    return a, b, (pairs, np.array([each[2] for each in found]))


def places(*counts: int) -> list[np.ndarray]:
    """Distinct pixels for the given number of features a view."""
    return [np.stack([np.arange(n), np.arange(n) + 100 * i], axis=1).astype(float) for i, n in enumerate(counts)]


def tracks(pixels, *found) -> set[frozenset[tuple[int, int]]]:
    view, number, track = feature_tracks(pixels, found)
    return {
        frozenset(zip(view[track == t].tolist(), number[track == t].tolist(), strict=True)) for t in np.unique(track)
    }


def test_matches_are_joined_to_tracks_the_clearest_first_and_none_has_two_places_of_a_view():
    found = matches(0, 1, (0, 3, 0.1), (1, 4, 0.1)), matches(1, 2, (3, 2, 0.1)), matches(0, 3, (0, 0, 0.2))
    assert tracks(places(5, 5, 5, 5), *found) == {
        frozenset({(0, 0), (1, 3), (2, 2), (3, 0)}),
        frozenset({(0, 1), (1, 4)}),
    }
    pixels = places(2, 2, 2)
    clear, chain = matches(0, 1, (0, 0, 0.1), (1, 1, 0.1)), matches(1, 2, (0, 0, 0.2), (1, 1, 0.2))
    wrong = matches(0, 2, (0, 1, 0.5))  # would join both tracks
    expected = {frozenset({(0, 0), (1, 0), (2, 0)}), frozenset({(0, 1), (1, 1), (2, 1)})}
    assert tracks(pixels, clear, chain, wrong) == tracks(pixels, wrong, chain, clear) == expected
    clearest = matches(0, 2, (0, 1, 0.01))
    assert tracks(pixels, clear, chain, clearest) == {frozenset({(0, 0), (1, 0), (2, 1)}), frozenset({(0, 1), (1, 1)})}

    pixels = places(3, 3, 3)
    pixels[1][2] = pixels[1][0]  # two orientations of one place
    found = matches(0, 1, (0, 0, 0.1)), matches(1, 2, (2, 1, 0.1))
    assert tracks(pixels, *found) == {frozenset({(0, 0), (1, 0), (2, 1)})}
    assert not tracks(places(3, 0)) and not tracks(places(3, 0), matches(0, 1))


def test_a_view_set_aside_joins_no_tracks_and_is_told_of_those_it_shows():
    pixels = places(3, 3, 3)
    found = [
        matches(0, 2, (0, 0, 0.3), (1, 1, 0.3)),
        matches(0, 1, (0, 0, 0.1), (1, 1, 0.1), (2, 2, 0.1)),
        matches(1, 2, (1, 2, 0.2), (0, 0, 0.2)),
    ]
    expected = {frozenset({(0, 0), (2, 0), (1, 0)}), frozenset({(0, 1), (2, 1), (1, 1)})}
    view, number, track = feature_tracks(pixels, found, np.array([False, True, False]))
    assert {frozenset(zip(view[track == t], number[track == t], strict=True)) for t in np.unique(track)} == expected
    # whatever it shows: the tracks of the others, and their numbers, are the same
    for other in ([found[0]], [found[0], matches(0, 1, (0, 1, 0.1)), matches(1, 2, (1, 1, 0.1))]):
        view2, number2, track2 = feature_tracks(pixels, other, np.array([False, True, False]))
        for of in (0, 2):
            assert track2[(view2 == of)].tolist() == track[view == of].tolist()
            assert number2[(view2 == of)].tolist() == number[view == of].tolist()
    # two such views alone make no track either
    view, _, _ = feature_tracks(pixels, [found[1]], np.array([True, True, False]))
    assert len(view) == 0
