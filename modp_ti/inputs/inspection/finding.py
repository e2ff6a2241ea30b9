"""What an inspection comes to: remarks with their mends, and a verdict."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

__all__ = ["Finding", "Severity", "verdict"]


class Severity(Enum):
    """How bad a finding is; the order is from harmless to fatal."""

    NOTE = "note"
    WARNING = "warning"
    UNUSABLE = "unusable"


@dataclass(frozen=True)
class Finding:
    """One thing that was found. code: a word for machines. mend: what to do about it, may be empty."""

    severity: Severity
    code: str
    text: str
    mend: str = ""


def verdict(findings: Iterable[Finding]) -> tuple[str, int]:
    """The word for all findings, fine, warnings or unusable, and the exit code of `modp-ti check`: 0, 1 or 2."""
    severities = {finding.severity for finding in findings}
    if Severity.UNUSABLE in severities:
        return "unusable", 2
    return ("warnings", 1) if Severity.WARNING in severities else ("fine", 0)
