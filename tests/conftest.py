"""Taichi, started anew for every test module."""

from __future__ import annotations

import pytest

from fields.backend import initialise


@pytest.fixture(autouse=True, scope="module")
def taichi_on_the_cpu() -> None:
    """Fields of an earlier module are gone: Taichi 1.7.4 writes beyond its memory once fields fill its first GB."""
    initialise("cpu")
