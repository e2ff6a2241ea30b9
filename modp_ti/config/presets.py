"""The presets of `modp-ti run`: named sets of settings for quick and for careful runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from modp_ti.files.errors import InputError

__all__ = ["PRESETS", "Preset", "markdown_of_presets", "with_preset"]


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

INTRODUCTION = """\
## Presets

`modp-ti run` has options that set several keys at once. A key in the scene file or with `--set` wins over the preset.
The `config.yaml` of a run holds every key, so a preset changes nothing there."""


def with_preset(settings: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return a copy of a scene's plain settings in which a preset sets the keys that are not given.

    Args:
        settings: Nested settings. A section that is not a mapping is left as it is, for the validation to report.
        name: Name of the preset.

    Raises:
        InputError: If there is no such preset.
    """
    if name not in PRESETS:
        raise InputError(f"there is no preset {name}: use {' or '.join(PRESETS)}")
    result = dict(settings)
    for key, value in PRESETS[name].settings.items():
        _set_missing(result, key.split("."), value)
    return result


def _set_missing(section: dict[str, Any], parts: list[str], value: Any) -> None:
    name, *deeper = parts
    if not deeper:
        section.setdefault(name, value)
        return
    inner = section.get(name, {})
    if isinstance(inner, Mapping):
        section[name] = dict(inner)
        _set_missing(section[name], deeper, value)


def markdown_of_presets() -> str:
    """Format the reference of the presets as Markdown: one row per key, one column per preset."""
    # Imported here: the command line reads the table without loading the models.
    from modp_ti.config.keys import as_yaml, documented_keys
    from modp_ti.config.settings import SceneConfig

    columns = [{entry.key: entry.default for entry in documented_keys(SceneConfig)}]
    columns += [{key: as_yaml(value) for key, value in preset.settings.items()} for preset in PRESETS.values()]
    lines = [INTRODUCTION, "", *(f"- `--{name}`: {preset.purpose}." for name, preset in PRESETS.items()), ""]
    lines += [_row(["key", "default", *(f"`--{name}`" for name in PRESETS)]), "|---" * (1 + len(columns)) + "|"]
    for key in dict.fromkeys(key for preset in PRESETS.values() for key in preset.settings):
        # A preset that does not set the key keeps its default.
        lines.append(_row([f"`{key}`", *(f"`{column.get(key, columns[0][key])}`" for column in columns)]))
    return "\n".join(lines) + "\n"


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
