"""Gaussians as a browser draws them, against SciPy's rotations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from modp_ti.outputs.viewer.modes import splats_of


def some(count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(4)
    return {
        "position": rng.normal(size=(count, 3)).astype(np.float32),
        "log_scale": rng.normal(-3, 0.5, (count, 3)).astype(np.float32),
        "quaternion": rng.normal(size=(count, 4)).astype(np.float32),
        "opacity_logit": rng.normal(size=count).astype(np.float32),
        "sh": rng.normal(0, 0.3, (count, 4, 3)).astype(np.float32),
    }


def test_splats_are_the_gaussians_in_the_units_of_the_page():
    state = some(50)
    splats = splats_of(state, 3.0, 100)
    assert splats.of == 50
    np.testing.assert_allclose(splats.centres, 3.0 * state["position"], rtol=1e-6)
    for i in range(50):
        R = Rotation.from_quat(state["quaternion"][i], scalar_first=True).as_matrix()
        expected = 9.0 * R @ np.diag(np.exp(2.0 * state["log_scale"][i])) @ R.T
        np.testing.assert_allclose(splats.covariances[i], expected, rtol=3e-4, atol=3e-6)
    np.testing.assert_allclose(splats.opacities[:, 0] / 255, 1 / (1 + np.exp(-state["opacity_logit"])), atol=0.002)
    # Of the harmonics only the constant one, 1 / (2 sqrt(pi)), is drawn.
    colour = np.clip(0.5 + state["sh"][:, 0] / (2 * np.sqrt(np.pi)), 0, 1)
    np.testing.assert_allclose(splats.colours / 255, colour, atol=0.002)


def test_of_a_large_map_a_subsample_is_drawn_that_covers_as_much():
    state = some(1000)
    splats = splats_of(state, 1.0, 250)
    assert len(splats.centres) == 250 and splats.of == 1000
    np.testing.assert_array_equal(splats.centres, state["position"][::4])
    areas = [np.prod(np.linalg.eigvalsh(c)) ** (1 / 3) for c in splats.covariances]
    expected = 4 * np.exp(2 * state["log_scale"][::4].mean(axis=1))
    np.testing.assert_allclose(areas, expected, rtol=1e-3)


def test_a_map_without_gaussians_has_no_splats():
    splats = splats_of({name: values[:0] for name, values in some(1).items()}, 1.0, 100)
    assert splats.centres.shape == (0, 3) and splats.covariances.shape == (0, 3, 3)
