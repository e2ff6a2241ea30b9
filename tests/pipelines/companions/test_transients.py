"""Views of a textured wall, rendered analytically: what moves, what the map lacks, ghosts, and the masks."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from fields.geometry.camera import PinholeCamera
from pipelines.companions.transients import CoarseView, coarse_view, moving, neighbours, soft_mask, votes
from pipelines.render.renderer import RenderedView

CAMERA = PinholeCamera(150.0, 150.0, 80.0, 60.0, 160, 120)
DEPTH = 2.0
STEPS = np.arange(9) * 0.05  # positions of the cameras along x


def wall(x: float, blot: float | None = None) -> NDArray[np.float64]:
    """Image (H, W, 3) of the wall z = 2 from a camera at `x`, with a red square of width 0.3 around x = `blot`."""
    u, v = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    X, Y = (u - 80) / 150 * DEPTH + x, (v - 60) / 150 * DEPTH
    colour = np.stack([0.5 + 0.2 * np.sin(9 * X + k) * np.cos(7 * Y + 2 * k) for k in range(3)], axis=-1)
    if blot is not None:
        colour[(np.abs(X - blot) < 0.15) & (np.abs(Y) < 0.15)] = [0.95, 0.05, 0.05]
    return colour


def view(x: float, render: NDArray[np.float64], image: NDArray[np.float64], valid: object = True) -> CoarseView:
    T = np.eye(4)
    T[0, 3] = -x
    rgba = np.dstack([np.rint(255 * image), np.full((120, 160), 255)]).astype(np.uint8)
    rgba[..., 3] *= np.broadcast_to(valid, (120, 160)).astype(np.uint8)
    return coarse_view(RenderedView(render, np.full((120, 160), DEPTH), np.ones((120, 160))), rgba, CAMERA, T)


def found(views: list[CoarseView], place: int, kept: bool) -> NDArray[np.bool_]:
    """The certain cells of one of the views, all others being asked."""
    others = [other for i, other in enumerate(views) if i != place]
    certain, likely = moving(views[place], others, kept)
    assert not (certain & ~likely).any()
    return certain


def square(x: float, blot: float, half: float) -> NDArray[np.bool_]:
    """Cells (60, 80) whose centres lie in the square of half the width `half` around `blot`, seen from `x`."""
    u, v = np.meshgrid(np.arange(80) + 0.5, np.arange(60) + 0.5)
    X, Y = (2 * u - 80) / 150 * DEPTH + x, (2 * v - 60) / 150 * DEPTH
    return (np.abs(X - blot) < half) & (np.abs(Y) < half)


@pytest.mark.parametrize("kept", [False, True])
def test_what_one_image_shows_and_the_map_does_not_moves(kept: bool) -> None:
    views = [view(x, wall(x), wall(x, 0.2 if i == 4 else None)) for i, x in enumerate(STEPS)]
    cells = found(views, 4, kept)
    assert cells[square(STEPS[4], 0.2, 0.12)].all()
    assert not cells[~square(STEPS[4], 0.2, 0.2)].any()
    assert not any(found(views, i, kept).any() for i in range(9) if i != 4)


def test_what_the_map_lacks_in_all_images_does_not_move() -> None:
    views = [view(x, wall(x), wall(x, 0.2)) for x in STEPS]
    # A cell at the edge of the square may be just wrong in one view and right in others: masks need more than one.
    assert max(found(views, i, kept=True).sum() for i in range(9)) <= 1


def test_a_ghost_in_the_map_moved_in_the_image_that_it_came_from() -> None:
    views = [view(x, wall(x, 0.2), wall(x, 0.2 if i == 4 else None)) for i, x in enumerate(STEPS)]
    cells = found(views, 4, kept=True)
    assert cells[square(STEPS[4], 0.2, 0.12)].all() and not cells[~square(STEPS[4], 0.2, 0.2)].any()
    assert not any(found(views, i, kept=True).any() for i in range(9) if i != 4)
    assert not found(views, 4, kept=False).any()  # the map saw no image of a held-out frame


def test_masked_pixels_neither_move_nor_vote() -> None:
    left = np.arange(160)[None] < 80
    images = [wall(x, 0.2 if i == 4 else None) for i, x in enumerate(STEPS)]
    views = [
        view(x, wall(x), image, ~left if i == 4 else True)
        for i, (x, image) in enumerate(zip(STEPS, images, strict=True))
    ]
    assert not found(views, 4, kept=True)[:, :40].any()
    blind = [view(x, wall(x), image, False) for x, image in zip(STEPS, images, strict=True)]
    assert not votes(np.array([[0.2, 0.0, DEPTH]]), blind).looks.any()


def test_a_point_gets_the_votes_of_the_views_that_see_its_surface() -> None:
    views = [view(x, wall(x), wall(x, 0.2 if i < 3 else None)) for i, x in enumerate(STEPS)]
    there, before, behind = np.array([0.2, 0.0, DEPTH]), np.array([0.2, 0.0, 1.0]), np.array([0.2, 0.0, -1.0])
    ballot = votes(np.stack([there, before, behind]), views)
    assert ballot.looks.tolist() == [9, 0, 0]
    assert ballot.wrong.tolist() == [3, 0, 0]
    assert ballot.right.tolist() == [6, 0, 0]
    assert ballot.mostly_right.tolist() == [True, False, False]


NOTHING = np.zeros((60, 80), dtype=bool)


def block(top: int, left: int, height: int, width: int) -> NDArray[np.bool_]:
    cells = NOTHING.copy()
    cells[top : top + height, left : left + width] = True
    return cells


def test_a_thing_is_masked_with_a_margin_and_a_soft_edge() -> None:
    thing = block(10, 20, 30, 12)
    mask = soft_mask(thing, thing)
    assert mask is not None and mask.dtype == np.uint8 and mask.shape == thing.shape
    assert (mask[thing] == 0).all()
    assert (mask[~binary_dilation(thing, np.ones((15, 15)))] == 255).all()
    row = mask[25, 32:45].astype(int)  # from the thing's edge outwards
    assert (np.diff(row) >= 0).all() and ((row > 0) & (row < 255)).any()


def test_a_likely_region_is_masked_from_a_certain_one_or_from_an_earlier_mask() -> None:
    likely, certain = block(10, 20, 30, 12), block(12, 22, 8, 8)
    mask = soft_mask(certain, likely)
    assert mask is not None and (mask[likely] == 0).all()
    assert soft_mask(NOTHING, likely) is None
    np.testing.assert_array_equal(soft_mask(NOTHING, likely, before=mask), mask)
    assert soft_mask(NOTHING, NOTHING, before=mask) is None
    assert soft_mask(NOTHING, block(10, 60, 30, 12), before=mask) is None


def test_neighbours_are_other_keyframes_near_and_far() -> None:
    for count in (1, 2, 9, 40, 200):
        for place in range(count):
            found = neighbours(place, count)
            assert len(set(found)) == len(found) <= 36
            assert all(0 <= other < count and abs(other - place) > 1 for other in found)
    far = neighbours(0, 200)
    assert np.diff(far).max() <= 13 and far[-1] >= 187
