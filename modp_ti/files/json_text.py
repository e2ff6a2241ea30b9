"""JSON reader whose errors name the file and the line."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from modp_ti.files.errors import InputError
from modp_ti.files.reading import read_text, readable

# An escaped UTF-16 surrogate. A valid character consists of a pair of them.
HALF_CHARACTER = re.compile(r"\\u[dD][89a-fA-F]")
# Integers with more characters than this become floats.
DIGITS = 18


def read_json(path: Path, setting: str) -> Any:
    """Read a JSON file; see `parse_json`.

    Args:
        path: The file.
        setting: The configuration key that names the file, for the error message.

    Raises:
        InputError: If the file cannot be read as text or is not valid JSON.
    """
    with readable(path, f" ({setting})"):
        text = read_text(path)
    return parse_json(text, str(path))


def parse_json(text: str, name: str, line: int = 1) -> Any:
    """Parse a JSON text.

    Numbers beyond the range of float64 become infinite, and `NaN` and `Infinity` are accepted. The caller must check
    that numbers are finite.

    Args:
        text: The JSON text.
        name: Name of the file, for the error message.
        line: Line of the file at which the text starts, for the error message.

    Raises:
        InputError: With the line, if the text is not valid JSON or is nested deeper than Python follows.
    """
    try:
        data = json.loads(text, parse_int=lambda digits: (int if len(digits) <= DIGITS else float)(digits))
        if HALF_CHARACTER.search(text):
            json.dumps(data, ensure_ascii=False).encode()
        return data
    except json.JSONDecodeError as error:
        raise _invalid(name, line + error.lineno - 1, error.msg) from None
    except UnicodeEncodeError:
        raise _invalid(name, line, "it holds half a character (a surrogate)") from None
    except RecursionError:
        raise _invalid(name, line, "it is nested too deep") from None
    except ValueError as error:
        raise _invalid(name, line, str(error)) from None


def _invalid(name: str, line: int, reason: str) -> InputError:
    return InputError(f"{name}:{line}: not valid JSON: {reason}; the file is cut off or damaged")
