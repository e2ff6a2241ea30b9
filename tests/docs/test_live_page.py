"""The page on live sessions: its commands are calls that the programs take."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer

from modp_ti.commands import app as cli

PROJECT = Path(__file__).resolve().parents[2]
PAGE = (PROJECT / "docs" / "live.md").read_text()


@pytest.mark.parametrize("command", re.findall(r"^modp-ti .*", PAGE, re.MULTILINE))
def test_the_command_is_a_valid_call(command: str) -> None:
    _, name, *arguments = shlex.split(command, comments=True)
    typer.main.get_command(cli.app).commands[name].make_context(name, arguments)  # raises for options it does not have
