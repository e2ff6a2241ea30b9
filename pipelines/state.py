"""`MapState`: the state of a mapper between two steps, as plain arrays and numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

__all__ = ["MapState"]


@dataclass(frozen=True)
class MapState:
    """State of a mapper between two steps.

    Attributes:
        arrays: Arrays, by `group.name`.
        numbers: JSON-compatible values.
    """

    arrays: dict[str, NDArray]
    numbers: dict[str, Any]

    @classmethod
    def of(cls, groups: Mapping[str, Mapping[str, NDArray]], numbers: Mapping[str, Any]) -> MapState:
        """Build a state from groups of arrays and from numbers."""
        arrays = {f"{group}.{name}": array for group, of in groups.items() for name, array in of.items()}
        return cls(arrays, dict(numbers))

    def group(self, group: str) -> dict[str, NDArray]:
        """Return the arrays of a group by name; empty if there is no such group."""
        start = group + "."
        return {name[len(start) :]: array for name, array in self.arrays.items() if name.startswith(start)}
