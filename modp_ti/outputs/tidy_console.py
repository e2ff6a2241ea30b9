"""`TidyConsole`: a console that can end the progress line which is shown, wherever an exception came from."""

from __future__ import annotations

from rich.console import Console
from rich.live import Live

__all__ = ["TidyConsole"]


class TidyConsole(Console):
    """A console that knows its progress line. See `rich.console.Console` for the arguments."""

    _line: Live | None = None

    def set_live(self, live: Live) -> bool:
        self._line = live
        return super().set_live(live)

    def tidy(self) -> None:
        """End the line that is shown, and show the cursor."""
        if self._line is not None:
            self._line.stop()
        self.show_cursor(True)
