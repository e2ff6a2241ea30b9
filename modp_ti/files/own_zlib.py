"""Keeps pycolmap's copy of zlib apart from the system's.

pycolmap's wheels export the functions of their zlib. If pycolmap is the first to load the system's libz.so.1, the
linker binds the calls within that library to pycolmap's functions, whose structures differ. From then on, compressing
anything aborts or hangs: PNG images of OpenCV and Pillow, and Python's zlib.
"""

from __future__ import annotations

import ctypes
import itertools
import mmap
import platform
import struct
import sys

LIBRARY = "libz.so.1"
# Kinds of relocations that hold the address of a symbol: R_X86_64_GLOB_DAT, _JUMP_SLOT; R_AARCH64_GLOB_DAT, _JUMP_SLOT.
KINDS = {"x86_64": (6, 7), "aarch64": (1025, 1026)}
# Tags of the dynamic section: sizes and addresses of the relocations, and the address of the symbols.
PLT_SIZE, SYMBOLS, RELOCATIONS, SIZE, PLT = 2, 6, 7, 8, 23


def keep_apart() -> None:
    """Load the system's zlib before pycolmap; if pycolmap was first, bind that library's calls to itself again."""
    if not sys.platform.startswith("linux"):  # elsewhere, libraries bind by name and library
        return
    try:
        library = ctypes.CDLL(LIBRARY)
    except OSError:
        return
    if "pycolmap" in sys.modules and platform.libc_ver()[0] == "glibc" and platform.machine() in KINDS:
        _bind_to_itself(library, KINDS[platform.machine()])


def _bind_to_itself(library: ctypes.CDLL, kinds: tuple[int, int]) -> None:
    """Let the calls of a library's own functions go there. They do already where another library has loaded it."""
    # A handle of glibc is the address of its `link_map`: load address, name, dynamic section.
    base, _, dynamic = struct.unpack("=QQQ", ctypes.string_at(library._handle, 24))
    tags: dict[int, int] = {}
    for place in itertools.count(dynamic, 16):
        tag, value = struct.unpack("=QQ", ctypes.string_at(place, 16))
        if tag == 0:
            break
        tags[tag] = value
    protect = ctypes.CDLL(None).mprotect
    protect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    for table, size in ((RELOCATIONS, SIZE), (PLT, PLT_SIZE)):
        for place in range(tags.get(table, 0), tags.get(table, 0) + tags.get(size, 0), 24):
            offset, info, _ = struct.unpack("=QQq", ctypes.string_at(place, 24))
            _, section, value = struct.unpack("=IxxHQ", ctypes.string_at(tags[SYMBOLS] + 24 * (info >> 32), 16))
            slot = ctypes.c_uint64.from_address(base + offset)
            if info & 0xFFFFFFFF in kinds and section and slot.value != base + value:
                page = (base + offset) // mmap.PAGESIZE * mmap.PAGESIZE
                if protect(page, mmap.PAGESIZE, mmap.PROT_READ | mmap.PROT_WRITE) == 0:
                    slot.value = base + value
