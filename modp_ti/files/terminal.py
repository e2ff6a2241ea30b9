"""What reaches the terminal: text without control characters, and no lines of native libraries.

All texts may hold names of files, and a name may hold anything: escape sequences that the terminal would obey, half
characters that cannot be printed, or markup of rich.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from threading import Lock

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from modp_ti.files.errors import InputError

_lock = Lock()
_users = 0
_own: int | None = None  # descriptor of Python's own standard error, if it has one


def shown(text: str) -> str:
    """Return a text as the terminal may show it: line ends and tabs stay, other control characters are escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode("ascii") for c in text)


def require_text(name: str) -> None:
    """Refuse the name of a file that is not valid UTF-8, as no output could name it. Raises InputError."""
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        raise InputError(f"{shown(name)}: the name is not UTF-8: rename it") from None


class CleanConsole(Console):
    """A console that shows every text as it is: without rich's markup, and with control characters escaped."""

    def __init__(self, stderr: bool = False, quiet: bool = False) -> None:
        super().__init__(stderr=stderr, quiet=quiet, markup=False, emoji=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=shown(segment.text))


def own_terminal() -> None:
    """Make a program's terminal fit for all that is written to it. Called once at its start, before other threads.

    Names of files are read and written as UTF-8 in every locale. No file gets the descriptor of a standard stream that
    is closed. Python's messages get a descriptor of their own, so that `quiet_libraries` can silence the other one
    without losing a line of any thread.
    """
    global _own
    if _own is not None or sys.stderr is not sys.__stderr__ or sys.stdout is not sys.__stdout__:
        return  # a caller in this process captures the output
    if os.name == "posix" and sys.getfilesystemencoding() != "utf-8" and os.environ.get("PYTHONUTF8") != "1":
        os.environ["PYTHONUTF8"] = "1"
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    while (free := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(free, True)
    os.close(free)
    warnings.filterwarnings("ignore", message="Image size .* exceeds limit", module=r"PIL\.Image")
    _own = os.dup(2)
    if sys.stderr is not None:
        sys.stderr.flush()
        sys.stderr = open(_own, "w", buffering=1, encoding="utf-8", errors="backslashreplace", closefd=False)


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Keep from the terminal what native libraries write within the block, such as libjpeg's "Corrupt JPEG data".

    They write to descriptor 2 and cannot be asked not to. Does nothing unless `own_terminal` was called, since messages
    of other threads would be lost.
    """
    global _users
    if _own is None:
        yield
        return
    with _lock:
        if _users == 0:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 2)
            os.close(null)
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0:
                os.dup2(_own, 2)
