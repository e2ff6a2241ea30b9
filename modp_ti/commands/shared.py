"""What the commands of `modp-ti` share: what they print where, how they end, and values that they take."""

from __future__ import annotations

import json
import os
import re
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modp_ti.files.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

__all__ = [
    "AsJson",
    "Device",
    "Outcome",
    "Overrides",
    "Quiet",
    "examples",
    "one_line",
    "outcome",
    "picture_size",
    "progress_console",
    "standalone",
]

# Exit codes; docs/commands.md has them all. 1 is `check`'s own: the input is usable, with warnings.
BAD_INPUT, FAULT, INTERRUPTED = 2, 3, 130

# Characters of a message, which may name what stands in a damaged file.
MAX_MESSAGE = 1000


class Device(str, Enum):
    """Where it is computed."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


def _settings(incomplete: str) -> list[tuple[str, str]]:
    from modp_ti.commands.completion import matching_settings

    return matching_settings(incomplete)


Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="no progress and no notes; errors are said all the same")]
AsJson = Annotated[bool, typer.Option("--json", help="print the result as one JSON object, and nothing else")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="sets a key of the scene file, for example --set source.scale=0.5; repeatable",
        autocompletion=_settings,
    ),
]


@dataclass
class Outcome:
    """What a command has to say at its end: a text for a person, data for a program, and the exit code."""

    code: int = 0
    text: str = ""
    data: dict[str, Any] = field(default_factory=dict)


@contextmanager
def outcome(as_json: bool) -> Iterator[Outcome]:
    """Prints the outcome that the block fills in, and ends the command as docs/commands.md says where it fails.

    What is wrong with the user's input is said in one line. as_json: the outcome is one JSON object; whatever else
    would be printed to standard output goes to standard error.
    """
    result = Outcome()
    try:
        with _to_standard_error() if as_json else nullcontext():
            yield result
    except InputError as error:
        _end(BAD_INPUT, one_line(error), as_json)
    except KeyboardInterrupt as stop:
        _end(INTERRUPTED, str(stop) or "interrupted", as_json)
    except Exception as error:
        traceback.print_exc()
        _end(FAULT, f"a fault of the program, not of your input; please report what stands above ({error!r})", as_json)
    if as_json:
        typer.echo(json.dumps({"exit_code": result.code, **result.data}, indent=2))
    elif result.text:
        typer.echo(result.text)
    if result.code:
        raise typer.Exit(result.code)


@contextmanager
def _to_standard_error() -> Iterator[None]:
    """Send what is printed to standard output there, by libraries that are not Python's too."""
    if sys.stdout is not sys.__stdout__:  # a caller in this process takes what is printed
        with redirect_stdout(sys.stderr):
            yield
        return
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def one_line(error: object) -> str:
    """An error as one line of a terminal: of limited length, without what a terminal would take for a command."""
    text = "".join(c if c.isprintable() else "?" for c in " ".join(str(error).split()))
    return text if len(text) <= MAX_MESSAGE else f"{text[: MAX_MESSAGE // 2]} ... {text[-MAX_MESSAGE // 2 :]}"


def _end(code: int, message: str, as_json: bool) -> None:
    typer.echo(f"error: {message}", err=True)
    if as_json:
        typer.echo(json.dumps({"exit_code": code, "error": message}, indent=2))
    raise typer.Exit(code) from None


def progress_console(quiet: bool) -> Console:
    """Where progress and notes are shown: standard error, or nowhere."""
    from rich.console import Console

    return Console(stderr=True, quiet=quiet)


def examples(*lines: str) -> str:
    """Example calls, each of which may be followed by its meaning, as the end of a help text."""
    return "\n".join(["Examples:", *(f"  {line}" for line in lines)])


def standalone(command: object, epilog: str) -> None:
    """Run one command as a program of its own, as `python -m modp_ti.run` does."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command(epilog=epilog)(command)
    app()


def picture_size(text: str) -> tuple[int, int]:
    """(width, height) of `WIDTHxHEIGHT`. Raises InputError for anything else."""
    found = re.fullmatch(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", text)
    if found is None:
        raise InputError(f"--size {text}: write it as WIDTHxHEIGHT, for example 640x480")
    return int(found[1]), int(found[2])
