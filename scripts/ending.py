"""Exit codes of the scripts, as documented in `docs/commands.md`."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

from modp_ti.commands.shared import BAD_INPUT, FAULT
from modp_ti.files.errors import InputError
from modp_ti.files.processes import EndingSignals, exit_code


@contextmanager
def documented_ending(*refusals: type[Exception]) -> Iterator[None]:
    """Context manager and decorator of `main` that converts exceptions to the documented exit codes.

    Args:
        *refusals: Exceptions that report bad input in one line, in addition to InputError.
    """
    signals = EndingSignals()
    try:
        yield
    except (InputError, *refusals) as error:
        print("error:", " ".join(str(error).split()), file=sys.stderr)
        code = BAD_INPUT
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        code = exit_code()
    except Exception as error:
        traceback.print_exc()
        print(f"error: a fault of the program, not of your input; please report it ({error!r})", file=sys.stderr)
        code = FAULT
    else:
        return
    finally:
        signals.give_back()
    raise SystemExit(code)
