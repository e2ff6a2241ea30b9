"""YAML reader for all of our files, which checks length, depth and aliases before it builds any object."""

from __future__ import annotations

import math
import re
from typing import Any

import yaml

from modp_ti.files.errors import InputError

# Characters, nodes, nesting depth, and characters of an integer.
MAX_TEXT, MAX_NODES, MAX_DEPTH, MAX_DIGITS = 1 << 18, 20_000, 16, 19
_INT = re.compile(r"[-+]?[0-9]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")


def parse_yaml(text: str, name: str, lines: dict[str, int]) -> Any:
    """Parse YAML 1.2 into plain data: `1e-3` is a number, `no` is text, and tags are ignored.

    Args:
        text: The YAML text.
        name: Name of the file, for the error message.
        lines: Filled with the line (from 1) of every dotted key.

    Raises:
        InputError: With the line, if it is not valid YAML, too long or too deep, has a key twice, an alias (and with it
            a merge key), or a number that is not finite.
    """
    if len(text) > MAX_TEXT:
        raise InputError(f"{name}: has {len(text):,} characters, where at most {MAX_TEXT:,} are taken")
    try:
        node = yaml.compose(text, Loader=_Loader)
        return None if node is None else _plain(node, "", name, lines)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{name}:{mark.line + 1}" if mark else name
        raise InputError(f"{place}: not valid YAML: {error.problem or error.context}") from None
    except yaml.YAMLError as error:
        raise InputError(f"{name}: not valid YAML: {' '.join(str(error).split())}") from None


class _Loader(yaml.SafeLoader):
    """Composes trees without aliases, a few lines of which can expand to any number of values."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = self._count = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event = self.peek_event()
        self._depth, self._count = self._depth + 1, self._count + 1
        problem = ""
        if isinstance(event, yaml.AliasEvent):
            problem = "an alias is not taken: write the value out"
        elif self._depth > MAX_DEPTH or self._count > MAX_NODES:
            problem = "too deep or too long for settings"
        if problem:
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


def _plain(node: yaml.Node, place: str, name: str, lines: dict[str, int]) -> Any:
    line = node.start_mark.line + 1
    if isinstance(node, yaml.MappingNode):
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key_line = key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode):
                raise InputError(f"{name}:{key_line}: a key must be a word")
            key = str(key_node.value)
            inner = f"{place}.{key}" if place else key
            if key in result:
                raise InputError(f"{name}:{key_line}: `{inner}` stands twice (first in line {lines[inner]})")
            lines[inner] = key_line
            result[key] = _plain(value_node, inner, name, lines)
        return result
    if isinstance(node, yaml.SequenceNode):
        return [_plain(item, f"{place}.{i}", name, lines) for i, item in enumerate(node.value)]
    value = str(node.value)
    if isinstance(node, yaml.ScalarNode) and node.style is not None:  # quoted or block text
        return value
    if value in ("", "~", "null", "Null", "NULL"):
        return None
    if value in ("true", "True", "TRUE", "false", "False", "FALSE"):
        return value[0] in "tT"
    if _INT.fullmatch(value) and len(value) <= MAX_DIGITS:
        return int(value)
    if _FLOAT.fullmatch(value) and math.isfinite(float(value)):
        return float(value)
    if _FLOAT.fullmatch(value) or value.lstrip("+-").lower() in (".inf", ".nan"):
        raise InputError(f"{name}:{line}: {place or 'the value'}: must be a finite number, not {value}")
    return value
