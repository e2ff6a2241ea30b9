"""Every kind of tracker that a scene may name has an opener, of its own settings."""

from __future__ import annotations

from typing import get_type_hints

import pytest

from modp_ti.config.keys import variants_of
from modp_ti.config.settings import SceneConfig, SourceSettings
from modp_ti.config.tracker_settings import TrackerSettings
from modp_ti.inputs.trackers import openers
from modp_ti.inputs.trackers.openers import OPENERS, Opening, opens

KINDS = variants_of(SceneConfig.model_fields["tracker"])


def test_every_kind_has_an_opener():
    assert list(OPENERS) == list(KINDS.values())


@pytest.mark.parametrize("kind", KINDS)
def test_an_opener_takes_the_settings_that_it_is_registered_for(kind):
    hints = get_type_hints(OPENERS[KINDS[kind]], vars(openers))
    assert KINDS[kind] in hints.values() and hints["opening"] is Opening


@pytest.mark.parametrize("kind", KINDS)
def test_settings_know_their_kind_and_what_it_can_do(kind):
    settings = KINDS[kind]()
    assert settings.kind == kind
    assert settings.needs_source == (kind != "socket")
    assert settings.brings_cameras == (kind in ("colmap", "transforms", "socket"))
    assert settings.follows_streams == (kind == "klt")
    assert settings.is_live == (kind == "socket")


def test_an_opener_can_be_added(monkeypatch):
    class Another(TrackerSettings):
        kind: str = "another"

    seen = []
    monkeypatch.setitem(OPENERS, Another, None)
    opens(Another)(lambda tracker, opening: seen.append((tracker.kind, opening.seed)))
    OPENERS[Another](Another(), Opening(SourceSettings(), seed=4))
    assert seen == [("another", 4)]
