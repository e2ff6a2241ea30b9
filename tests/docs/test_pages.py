"""The tutorial and the page on live sessions: their scene files are valid, and their commands are calls."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer

from modp_ti.commands import app as cli
from modp_ti.config.scene_file import load_scene

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGES = {name: (DOCS / f"{name}.md").read_text() for name in ("tutorial", "live")}
COMMANDS = {name: re.findall(r"^modp-ti .*", text, re.MULTILINE) for name, text in PAGES.items()}


@pytest.mark.parametrize("command", [command for commands in COMMANDS.values() for command in commands])
def test_the_command_is_a_valid_call(command: str) -> None:
    _, name, *arguments = shlex.split(command, comments=True)
    typer.main.get_command(cli.app).commands[name].make_context(name, arguments)  # raises for options it does not have


def test_the_scene_file_is_valid(tmp_path: Path) -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGES["tutorial"], re.DOTALL)
    (tmp_path / "scene.yaml").write_text(text)
    scene = load_scene(tmp_path / "scene.yaml")
    places = scene.source.path, scene.output
    assert (scene.tracker.kind, *places) == ("klt", tmp_path / "room.mp4", tmp_path / "out/room")


def test_the_settings_that_it_names_exist(tmp_path: Path) -> None:
    overrides = [
        word for command in COMMANDS["tutorial"] for word in shlex.split(command, comments=True) if "=" in word
    ]
    assert overrides
    scene = tmp_path / "scene.yaml"
    scene.write_text("source: {path: a.mp4}\ntracker: {kind: klt}\noutput: out\n")
    load_scene(scene, overrides)
