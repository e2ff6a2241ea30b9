"""Results of an inspection: findings with corrections, and a verdict."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from functools import partial

__all__ = ["Finding", "Severity", "note", "unusable", "verdict", "warning"]


class Severity(Enum):
    """Severity of a finding, in increasing order."""

    NOTE = "note"
    WARNING = "warning"
    UNUSABLE = "unusable"


@dataclass(frozen=True)
class Finding:
    """One finding.

    Attributes:
        severity: How severe it is.
        code: A machine-readable identifier.
        text: The finding in one line.
        mend: How to correct it; may be empty.
    """

    severity: Severity
    code: str
    text: str
    mend: str = ""


note = partial(Finding, Severity.NOTE)
warning = partial(Finding, Severity.WARNING)
unusable = partial(Finding, Severity.UNUSABLE)


def verdict(findings: Iterable[Finding]) -> tuple[str, int]:
    """Summarise findings as "fine", "warnings" or "unusable", with `modp-ti check`'s exit code 0, 1 or 2."""
    severities = {finding.severity for finding in findings}
    if Severity.UNUSABLE in severities:
        return "unusable", 2
    return ("warnings", 1) if Severity.WARNING in severities else ("fine", 0)
