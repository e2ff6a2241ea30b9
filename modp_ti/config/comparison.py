"""Comparison of the settings of two runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["differing_keys", "leaves"]


def differing_keys(before: Mapping[str, Any], now: Mapping[str, Any], free: Sequence[str]) -> list[str]:
    """Return the dotted keys whose values differ between two scenes' plain settings.

    Args:
        before: Nested settings.
        now: Nested settings, whose order the result follows.
        free: Keys and sections that may differ.
    """
    old, new = leaves(before), leaves(now)
    return [
        key
        for key in [*new, *(key for key in old if key not in new)]
        if old.get(key) != new.get(key) and not any(key == name or key.startswith(f"{name}.") for name in free)
    ]


def leaves(settings: Mapping[str, Any], start: str = "") -> dict[str, Any]:
    """Flatten nested settings to values by dotted key."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        flat |= leaves(value, f"{start}{key}.") if isinstance(value, Mapping) else {f"{start}{key}": value}
    return flat
