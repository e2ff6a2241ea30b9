"""pycolmap without log output, log files and signal handlers.

Import it from here, inside the function that needs it, since loading takes a while:

    from modp_ti.files.quiet_pycolmap import pycolmap

pycolmap logs through glog, which writes each warning of COLMAP and Ceres to standard error and to hidden files in /tmp
(`.host.user.log.WARNING...`). Failures reach the caller as a result or an exception, so only messages that abort the
process are logged. Set `GLOG_minloglevel=0` in the environment to see all messages.
"""

from __future__ import annotations

import ctypes
import os
import signal

__all__ = ["pycolmap"]

FATAL = 3  # glog's levels: 0 INFO, 1 WARNING, 2 ERROR

# On import, pycolmap installs a SIGTERM handler that prints a stack trace as for a crash. The previous handler is
# restored. `signal.signal()` cannot do this, because it works only in the main thread and this module may be imported
# in any.
_handler_of = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.c_int)(("PyOS_getsig", ctypes.pythonapi))
_set_handler = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)(("PyOS_setsig", ctypes.pythonapi))

_before = _handler_of(signal.SIGTERM)
import pycolmap  # noqa: E402, TID251 (the handler is asked for first, and this is the one place)

_set_handler(signal.SIGTERM, _before)
if "GLOG_minloglevel" not in os.environ:
    pycolmap.logging.minloglevel = FATAL
