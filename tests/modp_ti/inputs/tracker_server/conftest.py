"""The tracker server, without its patience for clients that do not listen."""

from __future__ import annotations

import pytest

from modp_ti.inputs.tracker_server import listening


@pytest.fixture(autouse=True)
def short_drain(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a fault the server reads on for a second, so that a client that still sends can read the reason."""
    monkeypatch.setattr(listening, "DRAIN_SECONDS", 0.05)
