"""The presets of `modp-ti run`: named sets of settings for quick and for careful runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Preset:
    """A named set of settings.

    Attributes:
        purpose: What it is for, in a few words.
        settings: Values by dotted key.
    """

    purpose: str
    settings: Mapping[str, Any]


PRESETS: Mapping[str, Preset] = {
    "fast": Preset(
        "a first look, in a fraction of the time",
        {"mapping.optimise.steps": 4, "refine.steps": 200},
    ),
    "best": Preset(
        "a map to keep, where time does not matter",
        {"mapping.optimise.steps": 30, "mapping.optimise.budget": None, "refine.steps": 3000},
    ),
}
"""All presets by name. `modp-ti run` has an option for each, and the reference lists them."""


def with_defaults(settings: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of nested settings in which values by dotted key are set where none is given.

    A section that is not a mapping is left as it is, for the validation to report.
    """
    result = dict(settings)
    for key, value in defaults.items():
        name, _, deeper = key.partition(".")
        if not deeper:
            result.setdefault(name, value)
        elif isinstance(section := result.get(name, {}), Mapping):
            result[name] = with_defaults(section, {deeper: value})
    return result
