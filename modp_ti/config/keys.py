"""Documentation of a configuration model: name, type, default and meaning of each key, and the page of all keys."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from modp_ti.files.urls import shown_url

__all__ = [
    "KeyDoc",
    "as_yaml",
    "documented_keys",
    "documented_values",
    "markdown_of_keys",
    "sections_of",
    "variants_of",
]

TYPE_NAMES = {int: "integer", float: "number", str: "text", bool: "true or false", Path: "path", NoneType: "empty"}

INTRODUCTION = """\
# Settings

This page lists every key of `scene.yaml`. Only `tracker.kind` and `output` are required, and `source.path`
for most trackers. Relative paths are relative to the scene file. An unknown key is an error that names the
nearest right one. Units are in square brackets. To override a key on the command line, use `--set`, whose paths are
relative to the folder where the command is typed; `--fast` and `--best` set several at once ([Presets](#presets)):

```sh
modp-ti run scene.yaml --set source.scale=0.5 --set refine.steps=3000
modp-ti run scene.yaml --fast
```

The tables are generated: `python -m modp_ti.config > docs/configuration.md`."""


def as_yaml(value: Any) -> str:
    """Format a value as one line of YAML, a URL without its secrets."""
    return json.dumps(shown_url(value) if isinstance(value, str) else value, ensure_ascii=False, default=str)


@dataclass(frozen=True)
class KeyDoc:
    """Documentation of one setting.

    Attributes:
        key: The dotted key.
        type: Its type in words.
        default: Its default as YAML text; None for a required key.
        description: Its meaning.
        variant: The kind of its section, for example of the tracker, if the keys of the section depend on the kind;
            otherwise empty.
        selects: Whether this key selects the kind of its section.
    """

    key: str
    type: str
    default: str | None
    description: str
    variant: str = ""
    selects: bool = False


def documented_keys(
    model: type[BaseModel], prefix: str = "", variant: str = "", kind_key: str = ""
) -> Iterator[KeyDoc]:
    """Iterate over the settings of a model in the order of their definition.

    A section with several kinds lists the keys of one kind after the other.

    Args:
        model: The settings model.
        prefix: Prefix of the dotted keys.
        variant: The kind of the section that the model describes, if the section has several.
        kind_key: The key of that section which selects the kind.
    """
    for name, info in model.model_fields.items():
        kinds = variants_of(info)
        selecting = str(info.discriminator) if kinds else ""
        sections = list(kinds.items()) or [(variant, section) for section in sections_of(info.annotation)]
        for tag, section in sections:
            yield from documented_keys(section, f"{prefix}{name}.", tag, selecting)
        if not sections:
            selects, default = name == kind_key, None
            if not selects and not info.is_required():
                value = info.get_default(call_default_factory=True, validated_data={})
                default = "" if value is None else as_yaml(value)
            description = info.description or ""
            yield KeyDoc(prefix + name, _type_name(info.annotation), default, description, variant, selects)


def documented_values(settings: BaseModel) -> Iterator[tuple[KeyDoc, Any]]:
    """Iterate over the documentation and value of each setting, in the order of their definition."""
    entries = list(documented_keys(type(settings)))
    kinds = {entry.variant for entry in entries if entry.selects and attrgetter(entry.key)(settings) == entry.variant}
    for entry in entries:
        if entry.variant in kinds | {""}:
            yield entry, attrgetter(entry.key)(settings)


def variants_of(info: FieldInfo) -> dict[str, type[BaseModel]]:
    """The models of a discriminated union by the values of its discriminator; empty for other fields."""
    if not isinstance(info.discriminator, str):
        return {}
    return {
        str(tag): model
        for model in sections_of(info.annotation)
        for tag in get_args(model.model_fields[info.discriminator].annotation)
    }


def sections_of(annotation: Any) -> list[type[BaseModel]]:
    """The models that a field accepts: one for `Section` and `Section | None`, none for a plain value."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    arguments = get_args(annotation)
    if get_origin(annotation) in (list, tuple, dict):
        return []
    return [model for argument in arguments for model in sections_of(argument)]


def _type_name(annotation: Any) -> str:
    if annotation in TYPE_NAMES:
        return TYPE_NAMES[annotation]
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return " or ".join(f"`{argument}`" for argument in arguments)
    if origin is Annotated:
        return _type_name(arguments[0])
    if origin in (list, tuple):
        return "list of " + _type_name(arguments[0])
    if arguments:
        return " or ".join(_type_name(argument) for argument in arguments)
    return getattr(annotation, "__name__", str(annotation))


def markdown_of_keys(model: type[BaseModel]) -> str:
    """Format the reference of all keys as Markdown, with one table per section, or per kind of a section."""
    sections: dict[str, dict[str, list[KeyDoc]]] = {}
    for entry in documented_keys(model):
        sections.setdefault(entry.key.rpartition(".")[0], {}).setdefault(entry.variant, []).append(entry)
    text = [INTRODUCTION]
    for section, variants in sections.items():
        text += ["", f"## {f'`{section}`' if section else 'Top level'}", ""]
        if "" in variants:
            text += _table(variants[""])
            continue
        selecting = [entry for entries in variants.values() for entry in entries if entry.selects]
        key = selecting[0].key
        text += [f"Its keys depend on `{key}`, which is required:", "", f"| `{key}` | meaning |", "|---|---|"]
        for entry in selecting:
            text.append(f"| [`{entry.variant}`](#{section}-of-kind-{entry.variant}) | {entry.description} |")
        for variant, entries in variants.items():
            text += ["", f"### `{section}` of kind `{variant}`", "", *_table(entries)]
    return "\n".join(text) + "\n"


def _table(entries: list[KeyDoc]) -> list[str]:
    lines = ["| key | type | default | meaning |", "|---|---|---|---|"]
    for entry in entries:
        default = "required" if entry.default is None else f"`{entry.default}`" if entry.default else "empty"
        cells = [f"`{entry.key}`", entry.type, default, entry.description]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return lines
