"""The tutorial: its scene file is valid, and its commands are calls that the program takes."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer

from modp_ti.commands import app as cli
from modp_ti.config.scene_file import load_scene

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "tutorial.md").read_text()
COMMANDS = re.findall(r"^modp-ti .*", PAGE, re.MULTILINE)


def test_the_scene_file_is_valid(tmp_path: Path) -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / "scene.yaml").write_text(text)
    scene = load_scene(tmp_path / "scene.yaml")
    assert (scene.tracker.kind, scene.source.path, scene.output) == (
        "klt",
        tmp_path / "room.mp4",
        tmp_path / "out/room",
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_the_command_is_a_valid_call(command: str) -> None:
    _, name, *arguments = shlex.split(command, comments=True)
    typer.main.get_command(cli.app).commands[name].make_context(
        name, arguments
    )  # raises for options that it does not have


def test_the_settings_that_it_names_exist(tmp_path: Path) -> None:
    overrides = [word for command in COMMANDS for word in shlex.split(command, comments=True) if "=" in word]
    assert overrides
    scene = tmp_path / "scene.yaml"
    scene.write_text("source: {path: a.mp4}\ntracker: {kind: klt}\noutput: out\n")
    load_scene(scene, overrides)
