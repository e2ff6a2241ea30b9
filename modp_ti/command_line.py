"""What the commands of `modp-ti` share: how they fail, and values that they take."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum

import typer

from modp_ti.errors import InputError

__all__ = ["Device", "in_one_line", "picture_size"]

BAD_INPUT = 2


class Device(str, Enum):
    """Where it is computed."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


@contextmanager
def in_one_line() -> Iterator[None]:
    """What is wrong with the user's input is said in one line, and ends the command with exit code BAD_INPUT."""
    try:
        yield
    except InputError as error:
        typer.echo(f"error: {' '.join(str(error).split())}", err=True)
        raise typer.Exit(BAD_INPUT) from None


def picture_size(text: str) -> tuple[int, int]:
    """(width, height) of `WIDTHxHEIGHT`. Raises InputError for anything else."""
    found = re.fullmatch(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", text)
    if found is None:
        raise InputError(f"--size {text}: write it as WIDTHxHEIGHT, for example 640x480")
    return int(found[1]), int(found[2])
