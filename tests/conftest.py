"""Taichi, started once for all tests of a process."""

from __future__ import annotations

import pytest
import taichi as ti

from fields.backend import initialise


@pytest.fixture(autouse=True, scope="session")
def taichi_on_the_cpu() -> None:
    """Started only where no other test has: another start would take the fields of their fixtures away."""
    if ti.lang.impl.get_runtime().prog is None:
        initialise("cpu")
