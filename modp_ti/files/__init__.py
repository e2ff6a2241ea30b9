"""Readers for untrusted files: only regular files are opened, and no allocation relies on a size that a file claims."""

from __future__ import annotations

from modp_ti.files.json_text import parse_json, read_json
from modp_ti.files.reading import (
    LARGEST,
    exists,
    input_lines,
    is_file,
    limited_lines,
    open_file,
    read_bytes,
    read_text,
    readable,
    text_lines,
)

__all__ = [
    "LARGEST",
    "exists",
    "input_lines",
    "is_file",
    "limited_lines",
    "open_file",
    "parse_json",
    "read_bytes",
    "read_json",
    "read_text",
    "readable",
    "text_lines",
]
