"""Shared parts of the commands: common options, output, error handling and exit codes."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import typer
from typer.core import TyperCommand, TyperGroup

from fields.runtime.engine import EngineError
from fields.runtime.process import why_too_narrow
from modp_ti.config.presets import PRESETS
from modp_ti.files.errors import InputError, without_secrets
from modp_ti.files.processes import EndingSignals, exit_code
from modp_ti.files.terminal import own_terminal, shown

if TYPE_CHECKING:
    from rich.console import Console

# Exit codes; docs/commands.md lists all of them. 1 has its own meaning in `check` and `locate`.
BAD_INPUT, FAULT = 2, 3

# Boxes on a narrow terminal cut the names of options.
MARKUP: Any = "rich" if shutil.get_terminal_size().columns >= 60 else None

# The errors of parsing, whose class typer does not export: a base of one that it does.
USAGE_ERROR: Any = typer.BadParameter.__mro__[1]

# Longest error message in characters, since messages may quote the content of a damaged file.
MAX_MESSAGE = 1000


Device = Literal["auto", "cpu", "cuda", "vulkan", "metal"]
Where = Literal["local", "ray"]


def matching_settings(incomplete: str) -> list[tuple[str, str]]:
    """Complete `--set KEY=VALUE`: return completions with the meanings of their keys.

    Settings with a plain default are offered as `key=default`, others as `key=`. A key that several kinds of a section
    have is offered once. A key that selects the kind is offered with each kind.
    """
    from modp_ti.config.keys import documented_keys
    from modp_ti.config.settings import SceneConfig

    found: dict[str, str] = {}
    for entry in documented_keys(SceneConfig):
        default = entry.variant if entry.selects else (entry.default or "").strip('"')
        plain = default if re.fullmatch(r"[\w./:+-]*", default) else ""
        offered = f"{entry.key}={plain}"
        if (offered if entry.selects else entry.key).startswith(incomplete):
            found.setdefault(offered, entry.description)
    return list(found.items())


Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="no progress and no notes; errors are said all the same")]
AsJson = Annotated[bool, typer.Option("--json", help="print the result as one JSON object, and nothing else")]
Fast = Annotated[bool, typer.Option("--fast", help=f"{PRESETS['fast'].purpose} (docs/configuration.md)")]
Best = Annotated[bool, typer.Option("--best", help=f"{PRESETS['best'].purpose} (docs/configuration.md)")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="sets a key of the scene file, for example --set source.scale=0.5; repeatable; paths are relative to the "
        "current folder",
        autocompletion=matching_settings,
    ),
]

Address = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="`ray`: address of the cluster; empty: RAY_ADDRESS, or this machine"),
]

OnDevice = Annotated[Device, typer.Option(help="`auto`: CUDA if there is a GPU, otherwise the CPU")]


def chosen_preset(fast: bool, best: bool) -> str | None:
    """Return the name of the preset that `--fast` or `--best` asks for. Raises InputError if both do."""
    if fast and best:
        raise InputError("--fast and --best are two presets: give one of them")
    return "fast" if fast else "best" if best else None


@dataclass
class Outcome:
    """The result of a command.

    Attributes:
        code: The exit code.
        text: Printed at the end.
        data: Printed instead as JSON with `--json`.
    """

    code: int = 0
    text: str = ""
    data: dict[str, Any] = field(default_factory=dict)


@contextmanager
def outcome(as_json: bool) -> Iterator[Outcome]:
    """Run a command's body, which fills in the outcome; print it and exit with the codes of docs/commands.md.

    An InputError or EngineError is printed in one line, any other exception with its traceback. With `as_json`, the
    outcome is printed as one JSON object, and everything else goes to standard error.
    """
    from modp_ti.outputs.progress import progress_ending

    result, signals = Outcome(), EndingSignals()
    own_terminal()
    if as_json and sys.stdout is None:
        _end(BAD_INPUT, "--json needs standard output, which is closed", as_json=False)
    try:
        with _to_standard_error() if as_json else nullcontext(), progress_ending():
            yield result
    except (InputError, EngineError) as error:
        _end(BAD_INPUT, one_line(error), as_json)
    except KeyboardInterrupt as stop:
        _end(exit_code(), str(stop) or "interrupted", as_json)
    except Exception as error:
        if (narrow := why_too_narrow()) is not None:
            _end(BAD_INPUT, narrow, as_json)
        sys.stderr.write(without_secrets(traceback.format_exc()))
        what = f"a fault of the program, not of your input; please report what stands above ({error!r})"
        _end(FAULT, without_secrets(what), as_json)
    finally:
        signals.give_back()
    if as_json:
        _say(json.dumps({"exit_code": result.code, **result.data}, indent=2))
    elif result.text:
        _say(shown(result.text))
    if result.code:
        raise typer.Exit(result.code)


@contextmanager
def _to_standard_error() -> Iterator[None]:
    """Redirect standard output to standard error, including that of native libraries."""
    if sys.stdout is not sys.__stdout__:  # a caller in this process captures the output
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
    """Format an error as one line of limited length without control characters."""
    text = shown(" ".join(without_secrets(str(error)).split()))
    return text if len(text) <= MAX_MESSAGE else f"{text[: MAX_MESSAGE // 2]} ... {text[-MAX_MESSAGE // 2 :]}"


def _end(code: int, message: str, as_json: bool) -> None:
    typer.echo(f"error: {message}", err=True)
    if as_json:
        _say(json.dumps({"exit_code": code, "error": message}, indent=2))
    raise typer.Exit(code) from None


def _say(text: str) -> None:
    """Print a result on standard output. A full disk or a closed pipe there is an error of one line."""
    try:
        typer.echo(text)
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)  # what is left in the buffer goes there when the interpreter ends
        os.close(null)
        typer.echo(f"error: the result cannot be written to standard output: {error.strerror}", err=True)
        raise typer.Exit(BAD_INPUT) from None


def progress_console(quiet: bool) -> Console:
    """A console for progress and notes, on standard error; it prints nothing if `quiet`."""
    from modp_ti.files.terminal import CleanConsole

    return CleanConsole(stderr=True, quiet=quiet)


def examples(*lines: str) -> str:
    """Format example calls, each optionally followed by its meaning, as the epilog of a help text."""
    kept = [] if MARKUP else ["\b"]  # without markup, this keeps the lines
    return "\n".join([*kept, "Examples:", *(f"  {line}" for line in lines)])


class Command(TyperCommand):
    """A command that reports wrong options as any other wrong input: in one line, and in JSON with `--json`."""

    def main(self, *args: Any, **settings: Any) -> Any:
        _parsed(super().main, *args, **settings)


class CommandGroup(TyperGroup):
    """A group of commands, with errors as `Command` has them."""

    def main(self, *args: Any, **settings: Any) -> Any:
        _parsed(super().main, *args, **settings)


def _parsed(main: Callable[..., Any], args: Sequence[str] | None = None, **settings: Any) -> NoReturn:
    """Run the `main` of a command with what was typed, and exit."""
    given = sys.argv[1:] if args is None else args
    try:
        sys.exit(main(given, **settings | {"standalone_mode": False}) or 0)
    except USAGE_ERROR as error:
        message = one_line(error.format_message()).removeprefix("Invalid value: ").replace("Value error, ", "")
        with suppress(typer.Exit):
            _end(BAD_INPUT, f"{message.rstrip('.')}; see --help", "--json" in given)
        sys.exit(BAD_INPUT)


def standalone(command: Callable[..., None], epilog: str) -> None:
    """Run one command as a separate program, as `python -m modp_ti.run` does."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=MARKUP)
    app.command(epilog=epilog, cls=Command)(command)
    app()


def picture_size(text: str) -> tuple[int, int]:
    """Parse `WIDTHxHEIGHT` as (width, height). Raises InputError for any other text."""
    found = re.fullmatch(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", text)
    if found is None:
        raise InputError(f"--size {text}: write it as WIDTHxHEIGHT, for example 640x480")
    return int(found[1]), int(found[2])
