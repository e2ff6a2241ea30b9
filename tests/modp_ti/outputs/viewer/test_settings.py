"""`view` in scene.yaml: a word, or a section."""

from __future__ import annotations

from pathlib import Path

import pytest

from modp_ti.config.scene_file import dump_scene, load_scene
from modp_ti.config.settings import ViewSettings
from modp_ti.files.errors import InputError


def settings(folder: Path, text: str, *overrides: str) -> ViewSettings:
    file = folder / "scene.yaml"
    file.write_text(f"source: {{path: images}}\ntracker: {{kind: colmap}}\noutput: out\n{text}\n")
    config = load_scene(file, overrides)
    dump_scene(config, folder / "again.yaml")
    assert load_scene(folder / "again.yaml").view == config.view
    return config.view


def test_nobody_looks_on_unless_asked_to_and_then_this_machine_alone(tmp_path: Path):
    assert not settings(tmp_path, "").enabled
    assert ViewSettings().host == "127.0.0.1"


@pytest.mark.parametrize(
    ("text", "overrides"),
    [
        ("view: true", ()),
        ("view: {port: 9000}", ()),
        ("view: {enabled: true}", ()),
        ("", ("view=true",)),
        ("", ("view.port=9000",)),
        ("view: {port: 9000}", ("view.enabled=true",)),
        ("view: true", ("view.port=9000",)),
        ("view: false", ("view.enabled=true",)),
    ],
)
def test_the_viewer_is_asked_for(tmp_path: Path, text: str, overrides: tuple[str, ...]):
    view = settings(tmp_path, text, *overrides)
    assert view.enabled
    assert view.port == (9000 if "9000" in text + str(overrides) else 8080)


@pytest.mark.parametrize("text", ["view: false", "view: {enabled: false, port: 9000}", "view: {}"])
def test_the_viewer_is_not_asked_for(tmp_path: Path, text: str):
    assert not settings(tmp_path, text).enabled


@pytest.mark.parametrize(
    ("text", "said"),
    [("view: yes", "view"), ("view: {prot: 1}", "did you mean `view.port`"), ("view: {port: -1}", "view.port")],
)
def test_mistakes_are_named(tmp_path: Path, text: str, said: str):
    with pytest.raises(InputError, match=said):
        settings(tmp_path, text)
