"""Matches are joined over the views, the clearest first, and never to two places of one view."""

from __future__ import annotations

import numpy as np

from modp_ti.inputs.multiview.feature_tracks import feature_tracks
from modp_ti.inputs.multiview.features import Matches


def matches(a: int, b: int, *found: tuple[int, int, float]) -> tuple[int, int, Matches]:
    pairs = np.array([each[:2] for each in found], dtype=np.int64).reshape(-1, 2)
    return a, b, Matches(pairs, np.array([each[2] for each in found]))


def places(*counts: int) -> list[np.ndarray]:
    """Distinct pixels for the given number of features a view."""
    return [np.stack([np.arange(n), np.arange(n) + 100 * i], axis=1).astype(float) for i, n in enumerate(counts)]


def tracks(pixels, *found) -> set[frozenset[tuple[int, int]]]:
    view, number, track = feature_tracks(pixels, found)
    return {
        frozenset(zip(view[track == t].tolist(), number[track == t].tolist(), strict=True)) for t in np.unique(track)
    }


def test_matches_that_share_a_feature_are_one_track():
    found = matches(0, 1, (0, 3, 0.1), (1, 4, 0.1)), matches(1, 2, (3, 2, 0.1)), matches(0, 3, (0, 0, 0.2))
    assert tracks(places(5, 5, 5, 5), *found) == {
        frozenset({(0, 0), (1, 3), (2, 2), (3, 0)}),
        frozenset({(0, 1), (1, 4)}),
    }


def test_a_match_to_a_second_place_of_a_view_is_left_out_and_the_clearest_ones_stay():
    pixels = places(2, 2, 2)
    clear, chain = matches(0, 1, (0, 0, 0.1), (1, 1, 0.1)), matches(1, 2, (0, 0, 0.2), (1, 1, 0.2))
    wrong = matches(0, 2, (0, 1, 0.5))  # would join both tracks
    expected = {frozenset({(0, 0), (1, 0), (2, 0)}), frozenset({(0, 1), (1, 1), (2, 1)})}
    assert tracks(pixels, clear, chain, wrong) == tracks(pixels, wrong, chain, clear) == expected
    clearest = matches(0, 2, (0, 1, 0.01))
    assert tracks(pixels, clear, chain, clearest) == {
        frozenset({(0, 0), (1, 0), (2, 1)}),
        frozenset({(0, 1), (1, 1)}),
    }


def test_features_at_one_place_are_one():
    pixels = places(3, 3, 3)
    pixels[1][2] = pixels[1][0]  # two orientations
    found = matches(0, 1, (0, 0, 0.1)), matches(1, 2, (2, 1, 0.1))
    assert tracks(pixels, *found) == {frozenset({(0, 0), (1, 0), (2, 1)})}


def test_tracks_are_numbered_without_gaps():
    found = matches(0, 1, (4, 0, 0.3), (0, 4, 0.1), (2, 2, 0.2))
    assert set(feature_tracks(places(5, 5), [found])[2].tolist()) == {0, 1, 2}


def test_no_matches_give_no_tracks():
    for found in ([], [matches(0, 1)]):
        view, number, track = feature_tracks(places(3, 0), found)
        assert len(view) == len(number) == len(track) == 0


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
