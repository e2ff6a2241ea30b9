from __future__ import annotations

import numpy as np
import pytest

from fields.geometry.se3 import exp_se3
from fields.map.gaussians import GaussianField
from fields.runtime.backend import initialise
from pipelines.render.renderer import Renderer
from pipelines.whole.shown_map import ShownMap
from tests.pipelines.wall import CAMERA


@pytest.fixture(scope="module")
def values(taichi_on_the_cpu: None) -> dict[str, np.ndarray]:
    """3,000 Gaussians in a ball around the cameras."""
    rng = np.random.default_rng(3)
    direction = rng.normal(0.0, 1.0, (3000, 3))
    return {
        "position": direction / np.linalg.norm(direction, axis=1)[:, None] * rng.uniform(2.0, 4.0, (3000, 1)),
        "log_scale": rng.normal(-2.5, 0.4, (3000, 3)),
        "quaternion": rng.normal(0.0, 1.0, (3000, 4)),
        "opacity_logit": rng.normal(0.0, 1.0, 3000),
        "sh": rng.normal(0.0, 1.0, (3000, 1, 3)),
    }


def renders(capacity: int, values: dict[str, np.ndarray]) -> tuple[list[np.ndarray], list[int]]:
    """Pictures in several directions, and the number of Gaussians that were loaded for each."""
    initialise("cpu")
    field = GaussianField(0, capacity)
    renderer, shown = Renderer(field, CAMERA.width, CAMERA.height), ShownMap(field, values)
    pictures, loaded = [], []
    for i in range(4):
        T = exp_se3([0.1 * i, 0.0, 0.0, 0.3, 1.5 * i, 0.0])
        shown.show(CAMERA, T)
        pictures.append(renderer.render(CAMERA, T, 0.01).colour)
        loaded.append(len(field))
    return pictures, loaded


def test_a_map_that_does_not_fit_looks_as_one_that_does(values: dict[str, np.ndarray]) -> None:
    whole, all_of_it = renders(4096, values)
    parts, some_of_it = renders(2048, values)
    assert all_of_it == [3000] * 4 and max(some_of_it) <= 2048 and min(some_of_it) > 0
    for one, other in zip(parts, whole, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_from_afar_merged_gaussians_look_as_the_whole_map(values: dict[str, np.ndarray]) -> None:
    initialise("cpu")
    few, many = GaussianField(0, 1024), GaussianField(0, 4096)
    T = exp_se3([0.0, 0.0, 30.0, 0.0, 0.0, 0.0])
    pictures, renderers = [], {}
    for field in (many, few):
        ShownMap(field, values).show(CAMERA, T)
        renderers[field] = Renderer(field, CAMERA.width, CAMERA.height)
        pictures.append(renderers[field].render(CAMERA, T, 0.01).colour)
    assert len(many) == 3000 and 300 < len(few) <= 1024
    whole, merged = (np.clip(picture, 0.0, 1.0) for picture in pictures)
    shown = whole.max(axis=2) > 0.02
    # A third of the Gaussians, chosen at random, are what it has to be better than.
    third = np.random.default_rng(0).permutation(3000)[: len(few)]
    many.load({name: array[third] for name, array in values.items()})
    chosen = np.clip(renderers[many].render(CAMERA, T, 0.01).colour, 0.0, 1.0)
    errors = [float(np.mean((picture - whole)[shown] ** 2)) for picture in (merged, chosen)]
    assert 4.0 * errors[0] < errors[1]
