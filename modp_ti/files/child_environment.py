"""`child_environment`: the environment of a process of ours that imports what this one does."""

from __future__ import annotations

import os
import sys


def child_environment(threads: int | None = None) -> dict[str, str]:
    """Return the environment variables for `python -c` in another process, which finds the same modules.

    Args:
        threads: Number of threads of the numerical libraries, None for their own choice.
    """
    places = os.pathsep.join(place or os.getcwd() for place in sys.path)
    libraries = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    limits = {} if threads is None else dict.fromkeys(libraries, str(threads))
    return {**os.environ, **limits, "PYTHONPATH": places, "PYTHONSAFEPATH": "1"}
