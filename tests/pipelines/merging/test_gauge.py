"""Exposures of several maps in one gauge: no image changes, and the colours of the maps agree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0
from pipelines.whole.merge import colour_changes, exposed_in, recoloured


def transform(rng: np.random.Generator) -> NDArray[np.float64]:
    return np.column_stack([np.eye(3) + 0.1 * rng.normal(size=(3, 3)), 0.05 * rng.normal(size=3)])


def applied(transform: NDArray[np.float64], colours: NDArray[np.float64]) -> NDArray[np.float64]:
    return colours @ transform[:, :3].T + transform[:, 3]


def test_an_image_stays_the_same_when_colours_and_exposure_change() -> None:
    rng = np.random.default_rng(1)
    colours, exposure, change = rng.random((7, 3)), transform(rng), transform(rng)
    image = applied(exposure, colours)
    np.testing.assert_allclose(applied(exposed_in(exposure, change), applied(change, colours)), image, atol=1e-12)


def test_harmonics_change_as_the_colours_that_they_make() -> None:
    rng = np.random.default_rng(2)
    sh, change = rng.normal(size=(5, 4, 3)), transform(rng)
    basis = np.array([SH_C0, *rng.normal(size=3)])  # in one direction
    colours = 0.5 + np.einsum("k,nkc->nc", basis, sh)
    after = 0.5 + np.einsum("k,nkc->nc", basis, recoloured(sh, change))
    np.testing.assert_allclose(after, applied(change, colours), atol=1e-12)


def test_the_changes_are_found_along_a_chain_of_shared_frames() -> None:
    """Maps whose colours are those of the scene after a transform of their own."""
    rng = np.random.default_rng(3)
    of_frame = {index: transform(rng) for index in range(12)}
    of_map = [np.eye(3, 4), transform(rng), transform(rng)]
    frames = [range(5), range(3, 9), range(8, 12)]
    exposures = [{i: exposed_in(of_frame[i], change) for i in own} for own, change in zip(frames, of_map, strict=True)]
    colours = rng.random((4, 3))
    for change, into in zip(of_map, colour_changes(exposures), strict=True):
        np.testing.assert_allclose(applied(into, applied(change, colours)), colours, atol=1e-9)


def test_maps_without_shared_frames_keep_the_gauge_before_them() -> None:
    rng = np.random.default_rng(4)
    shared = transform(rng)
    changes = colour_changes([{0: np.eye(3, 4)}, {0: shared, 1: shared}, {2: transform(rng)}])
    np.testing.assert_array_equal(changes[2], changes[1])
    np.testing.assert_allclose(changes[1], shared, atol=1e-12)
