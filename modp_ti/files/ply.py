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
    form, count, elements, properties = "", 0, [], []
    for words in map(str.split, data[:found].decode("ascii", "replace").splitlines()[1:]):
        match words:
            case ["format", form, *_]:
                pass
            case ["element", element, number] if number.isdecimal() and len(number) <= MAX_DIGITS:
                elements.append(element)
                count = int(number) if element == "vertex" else count
            case ["element", *_]:
                raise InputError(f"{path}: the PLY file is damaged: {' '.join(words)[:60]!r} in its header")
            case ["property", kind, name] if elements[-1:] == ["vertex"] and kind in PLY_TYPES:
                properties.append((name, PLY_TYPES[kind]))
            case ["property", *_] if elements[-1:] == ["vertex"]:
                raise InputError(f"{path}: vertices with `{' '.join(words)[:60]}` cannot be read")
    if elements[:1] != ["vertex"] or elements.count("vertex") > 1:
        raise InputError(f"{path}: the first element of the PLY file must be `vertex`, and the others not")
    if len(dict(properties)) != len(properties) or len(properties) > MAX_PROPERTIES:
        raise InputError(f"{path}: the PLY file is damaged: its vertices have one property twice, or too many")
    room = len(data) - newline - 1
    if form == "ascii":
        least = 2 * len(properties)  # one digit and one separator
        room += 1  # the last separator may be missing
    elif form in ("binary_little_endian", "binary_big_endian"):
        least = sum(int(kind[1:]) for _, kind in properties)
    else:
        raise InputError(f"{path}: PLY of format {form[:40]!r} cannot be read")
    if count * least > room:
        raise InputError(f"{path}: the PLY file is damaged or cut off: {count} vertices are announced, fewer are there")
    return PlyHeader(form, count, properties, newline + 1)
