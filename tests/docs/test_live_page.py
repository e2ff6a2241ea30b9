"""The page on live sessions: its commands are calls that the programs take."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
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


def test_the_options_of_the_script_exist() -> None:
    script = PROJECT / "scripts" / "live.py"
    helped = subprocess.run([sys.executable, str(script), "--help"], capture_output=True, text=True, check=True).stdout
    calls = " ".join(re.findall(r"^scripts/live .*", PAGE, re.MULTILINE))
    told = set(re.findall(r"(?<![\w-])--[a-z-]+", calls))
    told |= {"--stall", "--cut", "--unplug", "--kill-tracker", "--full-disk", "--seconds", "--cold"}
    assert told == {option for option in told if f"{option} " in helped or f"{option}]" in helped}
    assert all(f"`{option}" in PAGE or option in calls for option in told)
