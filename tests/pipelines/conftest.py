"""Renderers that the tests share: a kernel is compiled once for every instance, so that instances are dear."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from fields.map.gaussians import GaussianField
from fields.runtime.backend import initialise
from fields.runtime.engine import ti
from pipelines.render.renderer import Renderer

MAX_SIDE = 64


@pytest.fixture(scope="module")
def renderers(taichi_on_the_cpu: None) -> Callable[..., Renderer]:
    """The renderer of an SH degree and a precision, of images up to 64x64; tests load their own Gaussians into it.

    One lives at a time: another one starts Taichi anew (see the fixture above).
    """
    living: dict[tuple[int, object], Renderer] = {}

    def renderer(degree: int = 0, real: object = ti.f32) -> Renderer:
        held = living.get((degree, real))
        if held is None or not held.gaussians.tenancy.is_open:  # or a test between them has started Taichi anew
            if living:
                initialise("cpu")
                living.clear()
            living[degree, real] = Renderer(GaussianField(degree, max_gaussians=1 << 16, real=real), MAX_SIDE, MAX_SIDE)
        return living[degree, real]

    return renderer


@pytest.fixture
def renderer(renderers: Callable[..., Renderer]) -> Renderer:
    """The renderer as the mapper has it: float32, degree 0."""
    return renderers()
