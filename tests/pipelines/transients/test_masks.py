from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from pipelines.companions.transients import soft_mask

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


def test_specks_and_holes_do_not_count() -> None:
    thing = block(10, 20, 30, 12)
    mask = soft_mask(thing, thing)
    speckled = thing.copy()
    speckled[50, 70] = speckled[5, 5] = speckled[2:4, 60:62] = True
    speckled[20, 25] = speckled[30, 28] = False
    np.testing.assert_array_equal(soft_mask(speckled, speckled), mask)
    assert soft_mask(block(30, 30, 4, 4), block(30, 30, 4, 4)) is None


def test_most_of_the_image_never_moves() -> None:
    assert soft_mask(block(0, 0, 60, 60), block(0, 0, 60, 60)) is None


def test_a_likely_region_is_masked_from_a_certain_one_or_from_an_earlier_mask() -> None:
    likely, certain = block(10, 20, 30, 12), block(12, 22, 8, 8)
    mask = soft_mask(certain, likely)
    assert mask is not None and (mask[likely] == 0).all()
    assert soft_mask(NOTHING, likely) is None
    np.testing.assert_array_equal(soft_mask(NOTHING, likely, before=mask), mask)
    assert soft_mask(NOTHING, NOTHING, before=mask) is None
    assert soft_mask(NOTHING, block(10, 60, 30, 12), before=mask) is None
