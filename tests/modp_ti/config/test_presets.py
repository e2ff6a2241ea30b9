"""Presets set what nobody else has set, and the reference tells all of it."""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path

import pytest

from modp_ti.config.keys import documented_keys
from modp_ti.config.presets import PRESETS, markdown_of_presets, with_preset
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError

MINIMAL = "source: {path: images}\ntracker: {kind: colmap}\noutput: out\n"


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    file = tmp_path / "scene.yaml"
    file.write_text(MINIMAL)
    return file


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_sets_its_keys_and_no_other(scene: Path, name: str) -> None:
    plain, preset = load_scene(scene), load_scene(scene, preset=name)
    changed = {
        entry.key
        for entry in documented_keys(SceneConfig)
        if entry.variant in ("", "colmap") and attrgetter(entry.key)(plain) != attrgetter(entry.key)(preset)
    }
    assert changed == set(PRESETS[name].settings)
    for key, value in PRESETS[name].settings.items():
        assert attrgetter(key)(preset) == value


def test_the_scene_file_and_overrides_win_over_a_preset(scene: Path) -> None:
    scene.write_text(MINIMAL + "mapping: {optimise: {steps: 7}, sh_degree: 2}\n")
    config = load_scene(scene, ["refine.steps=11"], preset="fast")
    assert (config.mapping.optimise.steps, config.refine.steps, config.mapping.sh_degree) == (7, 11, 2)
    assert load_scene(scene, preset="fast").refine.steps == PRESETS["fast"].settings["refine.steps"]


def test_the_settings_given_are_left_as_they_are() -> None:
    given = {"mapping": {"optimise": {"steps": 7}}}
    result = with_preset(given, "best")
    assert given == {"mapping": {"optimise": {"steps": 7}}}
    assert result["mapping"]["optimise"]["steps"] == 7 and result["refine"]["steps"]


def test_a_section_that_is_none_is_reported_as_without_a_preset(scene: Path) -> None:
    scene.write_text(MINIMAL + "mapping: 7\n")
    with pytest.raises(InputError, match=r"scene\.yaml:4: mapping: must be an object, not 7"):
        load_scene(scene, preset="fast")


def test_an_unknown_preset_is_named(scene: Path) -> None:
    with pytest.raises(InputError, match="there is no preset slow: use fast or best"):
        load_scene(scene, preset="slow")


def test_the_fast_one_does_less_and_the_best_one_more_than_the_defaults() -> None:
    defaults = {entry.key: float(entry.default) for entry in documented_keys(SceneConfig) if entry.key in KEYS}
    for key in KEYS:
        assert PRESETS["fast"].settings[key] < defaults[key] < PRESETS["best"].settings[key]


KEYS = ("mapping.optimise.steps", "refine.steps")


def test_the_reference_has_every_value_beside_its_default() -> None:
    rows = [row.strip("| ").split(" | ") for row in markdown_of_presets().splitlines() if row.startswith("| `")]
    assert ["`refine.steps`", "`1000`", "`200`", "`3000`"] in rows
    assert {row[0].strip("`") for row in rows} == {key for preset in PRESETS.values() for key in preset.settings}
