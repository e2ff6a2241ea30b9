"""Bundle adjustment in a process of its own, for a thread beside which others shall go on.

pycolmap keeps Python's interpreter to itself while it solves, for seconds if there are hundreds of views.
"""

from __future__ import annotations

import pickle
import subprocess
import sys

from modp_ti.files.child_environment import child_environment
from modp_ti.inputs.multiview.bundle_adjustment import Bundle, adjusted_bundle

__all__ = ["adjusted_apart", "main"]

CODE = "from modp_ti.inputs.multiview.adjustment_process import main; main()"


def adjusted_apart(*arguments: object, **keywords: object) -> Bundle | None:
    """Call `adjusted_bundle` with these arguments in a process of its own.

    Returns:
        The same result; None also if the process fails, for example because memory is short.
    """
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        input=pickle.dumps((arguments, keywords)),
        stdout=subprocess.PIPE,
        env=child_environment(),
        start_new_session=True,  # Ctrl-C is for this process
        check=False,
    )
    return None if done.returncode else pickle.loads(done.stdout)


def main() -> None:
    """Serve one call, which comes through the standard input."""
    arguments, keywords = pickle.load(sys.stdin.buffer)
    sys.stdout.buffer.write(pickle.dumps(adjusted_bundle(*arguments, **keywords)))
