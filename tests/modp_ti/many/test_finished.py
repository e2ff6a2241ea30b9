"""What counts as a finished run of a scene."""

from __future__ import annotations

from pathlib import Path

import pytest

from modp_ti.config.scene_file import dump_scene, load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.many.scenes import finished_metrics


@pytest.fixture
def config(tmp_path: Path) -> SceneConfig:
    """Settings whose output folder holds a finished run of them, at the scale that `auto` became."""
    (tmp_path / "scene.yaml").write_text("source: {path: images}\ntracker: {kind: klt, maps: all}\noutput: out\n")
    config = load_scene(tmp_path / "scene.yaml")
    (tmp_path / "out").mkdir()
    dump_scene(config.resolved(0.75), tmp_path / "out" / "config.yaml")
    (tmp_path / "out" / "metrics.json").write_text('{"frames": 9}')
    return config


def test_a_run_with_the_same_settings_is_finished(config: SceneConfig) -> None:
    assert finished_metrics(config) == {"frames": 9}
    assert finished_metrics(config.model_copy(update={"threads": 3, "snapshot_every": 7, "device": "cpu"})) is not None


def test_a_run_with_other_settings_is_not(config: SceneConfig) -> None:
    assert finished_metrics(config.model_copy(update={"seed": 4})) is None
    assert finished_metrics(config.resolved(0.5)) is None
    assert finished_metrics(config.resolved(0.75)) is not None


def test_a_run_whose_further_maps_are_not_finished_is_not(config: SceneConfig) -> None:
    (config.output / "metrics.json").write_text('{"frames": 9, "further_maps": 2}')
    for place in (2, 3):
        assert finished_metrics(config) is None
        (config.output / f"map-{place}").mkdir()
        (config.output / f"map-{place}" / "metrics.json").write_text("{}")
    assert finished_metrics(config) is not None


@pytest.mark.parametrize("name", ["metrics.json", "config.yaml"])
@pytest.mark.parametrize("content", [None, "", "{", "[1]", "\0"])
def test_files_that_are_missing_or_damaged_are_no_finished_run(
    config: SceneConfig, name: str, content: str | None
) -> None:
    (config.output / name).unlink()
    if content is not None:
        (config.output / name).write_text(content)
    assert finished_metrics(config) is None
