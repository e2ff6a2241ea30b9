"""Time stamps in image names, such as nanoseconds in EuRoC's folders and fractional seconds in TUM's."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

__all__ = ["times_of_names"]

# Unit of a whole number by its digits, for times since 2001: milliseconds, microseconds, nanoseconds. Ten digits are
# not accepted: whole seconds would not distinguish the frames of a video.
UNITS = {13: 1e-3, 16: 1e-6, 19: 1e-9}
SECONDS = re.compile(r"[0-9]{10}\.[0-9]{2,}")


def times_of_names(names: Sequence[str]) -> NDArray[np.float64] | None:
    """Return the times (N,) [s] of images whose names are strictly increasing time stamps, otherwise None."""
    stems = [PurePosixPath(name).stem for name in names]
    if all(SECONDS.fullmatch(stem) for stem in stems):
        times = np.array([float(stem) for stem in stems])
    elif all(re.fullmatch("[1-9][0-9]+", stem) and len(stem) in UNITS for stem in stems):
        if len({len(stem) for stem in stems}) > 1:
            return None
        times = np.array([int(stem) for stem in stems]) * UNITS[len(stems[0])]
    else:
        return None
    return times if (np.diff(times) > 0).all() else None
