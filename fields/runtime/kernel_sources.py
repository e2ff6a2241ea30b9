"""Faster access to the source of kernels while the engine defines and compiles them.

The engine parses all kernels at every start of a process. Half of that time goes into notes of the source line of every
expression, which error messages would show, and into looking up a function's source at every call of it. At each
definition of a kernel it looks through all modules for the line that defines its class. The replacements here give the
same results; only a note in the code that is compiled has no carets below its line. A start takes two seconds less.

Quadrants parses every kernel twice. It is made to do so once, which takes another 0.6 seconds off a start.
"""

import ast
import functools
import linecache
import sys
import textwrap
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from fields.runtime.engine import engine, part

# Functions that look up a source, under the names that the engine's modules import them.
READERS = ("getsourcelines", "getsourcefile", "get_source_info_and_src")


def _noting_lines(with_carets: Callable[[Any, ast.expr], str]) -> Callable[[Any, ast.expr], str]:
    """Return a quick form of the engine's method that describes where a node is."""

    def position(self: Any, node: ast.expr) -> str:
        if self.raised:  # an error message: with carets
            return with_carets(self, node)
        line = f'File "{self.file}", line {node.lineno + self.lineno_offset}, in {self.func.func.__name__}:\n'
        return f"{line}{self.src[node.lineno - 1]}\n"

    return position


def _inside_class(level_of_class_stackframe: int) -> bool:
    """Return whether the frame so many levels above is just defining a class."""
    try:
        frame = sys._getframe(level_of_class_stackframe)
    except ValueError:  # a kernel of the main module
        return False
    line = linecache.getline(frame.f_code.co_filename, frame.f_lineno).strip()
    return any(pattern.match(line) for pattern in part("lang.kernel_impl")._KERNEL_CLASS_STACKFRAME_STMT_RES)


def _parse_once() -> None:
    """Leave out the pass that finds which fields of dataclass arguments a kernel uses: no kernel here has any.

    That pass also finds the arrays that a kernel reads as attributes of its object. Kernels here take arrays as
    arguments only, so that the set of those attributes is empty too.
    """
    module = part("lang.kernel")
    look_up = module.Kernel._try_load_fastcache

    class NothingFound(module.Pruning):
        def __init__(self, *arguments: Any, **named: Any) -> None:
            super().__init__(*arguments, **named)
            self.pass_0_ran = True

    def found(self: Any, arguments: tuple, key: Any) -> set[str]:
        used = look_up(self, arguments, key)
        if used is None:  # the first pass would run
            used = self.used_py_dataclass_parameters_by_key_enforcing[key] = set()
        return used

    module.Pruning = NothingFound
    module.Kernel._try_load_fastcache = found


@functools.cache
def answer_quickly() -> None:
    """Install the replacements in the engine, for the lifetime of the process."""
    module, context, method = engine().position_note
    note = getattr(part(module), context)
    setattr(note, method, _noting_lines(getattr(note, method)))
    part("lang.kernel_impl")._inside_class = _inside_class
    quick_textwrap = SimpleNamespace(fill=functools.cache(textwrap.fill), dedent=textwrap.dedent)
    for name in engine().source_readers:
        reader = part(name)
        if hasattr(reader, "textwrap"):
            reader.textwrap = quick_textwrap
        for function in READERS:
            if hasattr(reader, function):
                setattr(reader, function, functools.cache(getattr(reader, function)))
    if engine().parses_twice:
        _parse_once()
