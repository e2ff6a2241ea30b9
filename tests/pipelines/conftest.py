"""Renderers that the tests share: a kernel is compiled once for every instance, so that instances are dear."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest
import taichi as ti

from fields.gaussians import GaussianField
from pipelines.rendering import Renderer

MAX_SIDE = 64


@pytest.fixture(scope="session")
def renderers() -> Callable[..., Renderer]:
    """The renderer of an SH degree and a precision, of images up to 64x64; tests load their own Gaussians into it."""

    @cache
    def renderer(degree: int = 0, real: object = ti.f32) -> Renderer:
        return Renderer(GaussianField(degree, max_gaussians=1 << 16, real=real), MAX_SIDE, MAX_SIDE)

    return renderer


@pytest.fixture
def renderer(renderers: Callable[..., Renderer]) -> Renderer:
    """The renderer as the mapper has it: float32, degree 0."""
    return renderers()
