"""What the bytes of a small file may become: the bounds of all readers on packed data, archives, arrays and images.

A reader asks here before it allocates. With these bounds a file of a megabyte takes at most a gigabyte.
"""

from __future__ import annotations

import io
import math
import os
import re
import struct
import zipfile
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

# Data may unpack to this many bytes, plus this many times the packed ones. Text of numbers packs to a tenth, splats to
# a quarter.
SMALL, RATIO = 6 << 20, 25
PLAIN_NUMBERS = "biuf"
# A member may be packed in no other way: `zipfile` unpacks those of bzip2 and LZMA without a bound.
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
NPY_HEADER = re.compile(
    rb"\x93NUMPY[\1-\3]\0(?:..|....)\{ *'descr': *'([<>|=]?[a-zA-Z]\d{1,4})', *'fortran_order': *(True|False),"
    rb" *'shape': *\(((?:\d{1,12},? ?){0,6})\),? *\} *\n",
    re.DOTALL,
)


def most_unpacked(packed: int, ratio: int = RATIO) -> int:
    """Return the number of bytes to which so many packed ones may unpack at most."""
    return SMALL + ratio * packed


class BoundedZip(zipfile.ZipFile):
    """A zip archive whose members are read in bounded memory, whatever sizes it states.

    Args:
        file: The archive, or its content.
        stored: Whether members must be stored and lie within the file once, as in archives of arrays.

    Raises:
        zipfile.BadZipFile: If it is no zip archive, or is damaged. `read` raises it too, for a member that is damaged,
            encrypted, packed in another way than stored or deflated, or that unpacks to too much.
    """

    def __init__(self, file: Path | BinaryIO | bytes, stored: bool = False) -> None:
        opened = io.BytesIO(file) if isinstance(file, bytes) else file
        try:
            super().__init__(opened)
            members = self.infolist()
        except (ValueError, NotImplementedError, LookupError, struct.error) as error:
            raise zipfile.BadZipFile(f"it is no zip archive, or is cut off ({error})") from None
        assert self.fp is not None, "it has just been opened"
        self._size = self.fp.seek(0, os.SEEK_END)
        if stored and (
            any(each.compress_type != zipfile.ZIP_STORED or each.file_size != each.compress_size for each in members)
            or sum(each.file_size for each in members) > self._size
        ):
            self.close()
            raise zipfile.BadZipFile("a member is compressed, or longer than the file")

    def read(self, name: str | zipfile.ZipInfo, pwd: bytes | None = None) -> bytes:
        """Unpack a member. Raises KeyError if there is none of this name."""
        info = name if isinstance(name, zipfile.ZipInfo) else self.getinfo(name)
        if info.compress_type not in PACKINGS:
            raise zipfile.BadZipFile("it is packed in another way than stored or deflated: pack it again")
        if info.file_size > most_unpacked(min(info.compress_size, self._size)):
            raise zipfile.BadZipFile(f"it claims to unpack to {info.file_size >> 20} MiB")
        try:
            with self.open(info, pwd=pwd) as member:
                data = member.read(info.file_size)  # no more is unpacked than is asked for
        except (zlib.error, EOFError, ValueError, NotImplementedError, RuntimeError, LookupError, struct.error):
            raise zipfile.BadZipFile("it is damaged, encrypted or packed in an unknown way") from None
        if len(data) < info.file_size:
            raise zipfile.BadZipFile("it is shorter than it claims")
        return data


def arrays_of(archive: BoundedZip, kinds: str = PLAIN_NUMBERS) -> dict[str, NDArray]:
    """Return the arrays of an .npz archive by name. Errors are those of `array_of` and `BoundedZip`."""
    found = {}
    for info in archive.infolist():
        name = info.filename.removesuffix(".npy")
        if name == info.filename or name in found:
            raise ValueError(f"{info.filename} is not an array, or occurs twice")
        try:
            found[name] = array_of(archive.read(info), kinds).copy()
        except ValueError as error:
            raise ValueError(f"{info.filename} {error}") from None
    return found


def array_of(data: bytes, kinds: str = PLAIN_NUMBERS) -> NDArray:
    """Return the array of an .npy file as a view of its content. Its header is matched, not evaluated.

    Args:
        data: The content.
        kinds: The kinds of NumPy's types that are accepted.

    Raises:
        ValueError: If it is none, or does not have the length that its header states.
    """
    header = NPY_HEADER.match(data)
    if header is None:
        raise ValueError("holds not plain numbers, or no array")
    try:
        dtype = np.dtype(header[1].decode("ascii"))
    except TypeError:
        raise ValueError("holds an unknown type, not plain numbers") from None
    shape = tuple(int(side) for side in re.findall(rb"\d+", header[3]))
    if dtype.kind not in kinds:
        raise ValueError(f"holds {dtype}, not plain numbers")
    if math.prod(shape) * dtype.itemsize != len(data) - header.end():
        raise ValueError("does not have the announced length")
    values = np.frombuffer(data, dtype, offset=header.end())
    return values.reshape(shape, order="F" if header[2] == b"True" else "C")
