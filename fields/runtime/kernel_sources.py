"""What Taichi asks Python about a kernel's source, asked once and answered without delay.

Taichi 1.7.4 turns a kernel's Python into its own form at every start of a process, and takes half of that time to fold
each expression's line for messages that nobody may ever read, and to look up a function's lines at every call of it.
Here the answers are the same; a run starts a second earlier.
"""

import functools
import textwrap

from taichi.lang import kernel_impl
from taichi.lang.ast import ast_transformer_utils

__all__ = ["QuickWrapper", "answer_quickly"]


class QuickWrapper(textwrap.TextWrapper):
    """Folds a text as its parent does, and sees at once where there is nothing to fold."""

    def wrap(self, text: str) -> list[str]:
        """The lines of at most `width` characters that the text is folded to."""
        if len(text) > self.width or not text.isprintable():
            return super().wrap(text)
        text = text.rstrip()
        return [text] if text else []


@functools.cache
def answer_quickly() -> None:
    """Have Taichi ask here. For the life of the process."""
    ast_transformer_utils.TextWrapper = QuickWrapper
    kernel_impl.getsourcelines = functools.cache(kernel_impl.getsourcelines)
    kernel_impl.getsourcefile = functools.cache(kernel_impl.getsourcefile)
