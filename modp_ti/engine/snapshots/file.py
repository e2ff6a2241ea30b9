"""The snapshot file: an uncompressed .npz of plain arrays, one of which holds JSON. It contains no executable code.

The reader does not use `numpy.load`, because the file may be damaged or hostile (`modp_ti.files.limits`).
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modp_ti.files import open_file
from modp_ti.files.atomic import replacing
from modp_ti.files.errors import InputError
from modp_ti.files.limits import BoundedZip, arrays_of
from modp_ti.version import __version__

__all__ = ["FILE", "VERSION", "of_another_program", "read_arrays", "write_arrays"]

FILE = "snapshot.npz"
# Version of the arrays and the JSON. Others are refused, as they hold the state of different code.
VERSION = 5
ABOUT = "about"


def write_arrays(path: Path, arrays: Mapping[str, NDArray], about: Mapping[str, Any]) -> None:
    """Write named arrays of numbers and the JSON object `about`. Raises OSError if the file cannot be written.

    The previous file is replaced only once the new one is on disk.
    """
    text = json.dumps({"version": VERSION, "program": __version__, **about}).encode("utf-8")
    with replacing(path) as file:
        np.savez(file, allow_pickle=False, **arrays, **{ABOUT: np.frombuffer(text, dtype=np.uint8)})


def read_arrays(path: Path) -> tuple[dict[str, NDArray], dict[str, Any]]:
    """Read the arrays by name and the JSON object of a file that `write_arrays` wrote.

    Raises:
        InputError: If the file is missing, damaged, not a snapshot, or of another version. The message has one line.
    """
    try:
        with open_file(path) as file, BoundedZip(file, stored=True) as archive:
            arrays = arrays_of(archive)
        about = json.loads(bytes(arrays.pop(ABOUT)))
        version = about["version"]
    except OSError as error:
        raise InputError(f"{path}: the snapshot cannot be read: {error.strerror}") from None
    except (zipfile.BadZipFile, ValueError, KeyError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not a snapshot, or a damaged one ({reason}); start the run from its scene") from None
    if version != VERSION:
        raise of_another_program(path, about.get("program"), f"its format is {version}, and this program's {VERSION}")
    return arrays, about


def of_another_program(path: Path, program: object, difference: str) -> InputError:
    """Return the error for a snapshot of another version of the program, None if it is unknown, with its difference."""
    wrote = f"MODP-Ti {program}" if isinstance(program, str) else "an earlier version of MODP-Ti"
    return InputError(
        f"{path}: {wrote} has written this snapshot, and MODP-Ti {__version__} cannot resume it ({difference}); "
        "resume with that version, or start the run from its scene"
    )
