"""Every kind of tracker that a scene may name can be opened, and its settings say what it can do."""

from __future__ import annotations

import re

import pytest

from modp_ti.config.keys import variants_of
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_tracker
from tests.opening import CAPTURES

KINDS = variants_of(SceneConfig.model_fields["tracker"])


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_opened_and_names_what_is_missing(tmp_path, kind):
    source = {} if kind == "socket" else {"path": tmp_path / "gone"}
    tracker = {"kind": kind, **({"path": tmp_path / "gone" / "socket"} if kind == "socket" else {})}
    config = SceneConfig.model_validate({"source": source, "tracker": tracker, "output": tmp_path / "out"})
    with pytest.raises(InputError, match=re.escape(str(tmp_path))):
        open_tracker(config)


@pytest.mark.parametrize("kind", KINDS)
def test_settings_know_their_kind_and_what_it_can_do(kind):
    settings = KINDS[kind]()
    assert settings.kind == kind
    assert settings.needs_source == (kind != "socket")
    assert settings.brings_cameras == (kind in ("colmap", "transforms", "socket", *CAPTURES))
    assert settings.follows_streams == (kind == "klt")
    assert settings.is_live == (kind == "socket")
