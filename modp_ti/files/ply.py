"""Parser for PLY headers, which checks the vertex count against the file size before anything is allocated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from modp_ti.files.errors import InputError

# Largest header in bytes. Splats with the highest spherical harmonics degree need about 2,000.
MAX_HEADER = 1 << 16
MAX_DIGITS = 12
MAX_PROPERTIES = 1000

PLY_TYPE_NAMES = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
PLY_TYPES = {name: code for code, names in PLY_TYPE_NAMES.items() for name in names}


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file whose first element is `vertex`.

    Attributes:
        form: The file's format, for example `binary_little_endian`.
        count: Number of vertices.
        properties: Name and NumPy type (without byte order) of each vertex property.
        start: Offset of the data in bytes.
    """

    form: str
    count: int
    properties: list[tuple[str, str]]
    start: int

    @property
    def names(self) -> list[str]:
        """Names of the vertex properties."""
        return [name for name, _ in self.properties]


def parse_ply_header(data: bytes, path: Path) -> PlyHeader:
    """Parse the header at the start of a PLY file.

    Args:
        data: The content of the whole file.
        path: The file's path, for error messages.

    Raises:
        InputError: If the header is missing, damaged or unsupported, or announces more vertices than `data` can hold.
    """
    found = data.find(b"end_header", 0, MAX_HEADER)
    newline = data.find(b"\n", found, found + 16)
    if not data.startswith(b"ply") or found < 0 or newline < 0:
        raise InputError(f"{path}: not a PLY file")
    header = _parsed(data[:found].decode("ascii", "replace").splitlines()[1:], newline + 1, path)
    room = len(data) - header.start
    if header.form == "ascii":
        least = 2 * len(header.properties)  # one digit and one separator
        room += 1  # the last separator may be missing
    elif header.form in ("binary_little_endian", "binary_big_endian"):
        least = sum(int(kind[1:]) for _, kind in header.properties)
    else:
        raise InputError(f"{path}: PLY of format {header.form[:40]!r} cannot be read")
    if header.count * least > room:
        raise InputError(
            f"{path}: the PLY file is damaged or cut off: {header.count} vertices are announced and fewer are there"
        )
    return header


def _parsed(lines: list[str], start: int, path: Path) -> PlyHeader:
    form, count, element = "", 0, ""
    elements: list[str] = []
    properties: list[tuple[str, str]] = []
    for words in map(str.split, lines):
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) >= 2:
            form = words[1]
        elif words[0] == "element":
            if len(words) != 3 or not words[2].isdecimal() or len(words[2]) > MAX_DIGITS:
                raise InputError(f"{path}: the PLY file is damaged: {' '.join(words)[:60]!r} in its header")
            element = words[1]
            elements.append(element)
            count = int(words[2]) if element == "vertex" else count
        elif words[0] == "property" and element == "vertex":
            if len(words) != 3 or words[1] not in PLY_TYPES:
                raise InputError(f"{path}: vertices with `{' '.join(words)[:60]}` cannot be read")
            properties.append((words[2], PLY_TYPES[words[1]]))
    names = {name for name, _ in properties}
    if not elements or elements[0] != "vertex" or elements.count("vertex") > 1:
        raise InputError(f"{path}: the first element of the PLY file must be `vertex`, and the others not")
    if len(names) != len(properties) or len(properties) > MAX_PROPERTIES:
        raise InputError(f"{path}: the PLY file is damaged: its vertices have one property twice, or too many")
    return PlyHeader(form, count, properties, start)
