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


@pytest.mark.parametrize(
    ("text", "overrides", "enabled"),
    [
        ("", (), False),
        ("view: false", (), False),
        ("view: {enabled: false, port: 9000}", (), False),
        ("view: true", (), True),
        ("view: {port: 9000}", (), True),
        ("", ("view=true",), True),
        ("", ("view.port=9000",), True),
        ("view: false", ("view.enabled=true",), True),
        ("view: true", ("view.port=9000",), True),
    ],
)
def test_the_viewer_is_asked_for_and_shows_to_this_machine(
    tmp_path: Path, text: str, overrides: tuple[str, ...], enabled: bool
):
    view = settings(tmp_path, text, *overrides)
    assert (view.enabled, view.host) == (enabled, "127.0.0.1")
    assert view.port == (9000 if "9000" in text + str(overrides) else 8080)


@pytest.mark.parametrize(("text", "named"), [("view: yes", "view"), ("view: {prot: 1}", "view.port")])
def test_mistakes_are_named(tmp_path: Path, text: str, named: str):
    with pytest.raises(InputError, match=named):
        settings(tmp_path, text)
