"""A plane that is filmed, of which the tests write recordings."""

from __future__ import annotations

import pytest

from tests.samples.filmed import Filmed, film


@pytest.fixture(scope="session")
def filmed() -> Filmed:
    """Seven views of 320x240."""
    return film(7, (320, 240), [f"view{i}.png" for i in range(8, 15)])  # not in the order of the alphabet
