"""How the scripts end: with the exit codes that `docs/commands.md` tells of."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

from modp_ti.commands.shared import BAD_INPUT, FAULT, INTERRUPTED
from modp_ti.files.errors import InputError

__all__ = ["documented_ending"]


@contextmanager
def documented_ending(*refusals: type[Exception]) -> Iterator[None]:
    """Ends the program where the block fails, also as a decorator of `main`.

    refusals: exceptions beside InputError that tell, in one line, what is wrong with the input.
    """
    try:
        yield
    except (InputError, *refusals) as error:
        print("error:", " ".join(str(error).split()), file=sys.stderr)
        code = BAD_INPUT
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        code = INTERRUPTED
    except Exception as error:
        traceback.print_exc()
        print(f"error: a fault of the program, not of your input; please report it ({error!r})", file=sys.stderr)
        code = FAULT
    else:
        return
    raise SystemExit(code)
