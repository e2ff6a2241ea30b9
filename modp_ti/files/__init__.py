"""Files of the user and of runs: read with limits, and written whole or not at all."""

from __future__ import annotations

from modp_ti.files.reading import (
    LARGEST,
    input_lines,
    open_file,
    parse_json,
    read_bytes,
    read_json,
    read_text,
    reading,
)

__all__ = [
    "LARGEST",
    "input_lines",
    "open_file",
    "parse_json",
    "read_bytes",
    "read_json",
    "read_text",
    "reading",
]
