"""The library pycolmap, imported so that it leaves the user's terminal, /tmp and the process's signals alone.

Every module of ours takes it from here, and inside the function that needs it: it takes a while to load.

    from modp_ti.files.quiet_pycolmap import pycolmap

pycolmap logs through glog, which writes each warning of COLMAP and Ceres to standard error and to hidden files in /tmp
(`.host.user.log.WARNING...`). What goes wrong reaches us as a result or an exception, which say it in our one line; so
only what aborts the process is still logged. `GLOG_minloglevel=0` in the environment shows all.
"""

from __future__ import annotations

import ctypes
import os
import signal

__all__ = ["pycolmap"]

FATAL = 3  # glog's levels: 0 INFO, 1 WARNING, 2 ERROR

# When it is imported, pycolmap installs a handler that prints a stack trace for SIGTERM as for a crash. The handler
# that was there before (Python's, or none) is put back. signal.signal() cannot do that: it works in the main thread
# alone, and this may be imported in any.
_handler_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.c_int)(("PyOS_getsig", ctypes.pythonapi))
_set_handler = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)(("PyOS_setsig", ctypes.pythonapi))

_before = _handler_of(signal.SIGTERM)
import pycolmap  # noqa: E402, TID251 (the handler is asked for first, and this is the one place)

_set_handler(signal.SIGTERM, _before)
if "GLOG_minloglevel" not in os.environ:
    pycolmap.logging.minloglevel = FATAL
