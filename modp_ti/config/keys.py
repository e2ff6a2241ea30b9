"""Documentation of a configuration model: name, type, default and meaning of each key, and the page of all keys."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

__all__ = [
    "KeyDoc",
    "as_yaml",
    "documented_keys",
    "documented_values",
    "markdown_of_keys",
    "sections_of",
    "variants_of",
]


def as_yaml(value: Any) -> str:
    """Format a value as one line of YAML."""
    return json.dumps(value, ensure_ascii=False, default=str)


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


def documented_keys(model: type[BaseModel], prefix: str = "") -> Iterator[KeyDoc]:
    """Iterate over the settings of a model in the order of their definition.

    A section with several kinds lists the keys of one kind after the other.

    Args:
        model: The settings model.
        prefix: Prefix of the dotted keys.
    """
    return _keys(model, prefix, "", "")


def _keys(model: type[BaseModel], prefix: str, variant: str, tells_kind: str) -> Iterator[KeyDoc]:
    for name, info in model.model_fields.items():
        for tag, section in variants_of(info).items():
            yield from _keys(section, f"{prefix}{name}.", tag, str(info.discriminator))
        sections = sections_of(info.annotation)
        if info.discriminator is None:
            for section in sections:
                yield from _keys(section, f"{prefix}{name}.", variant, "")
        if not sections:
            yield _documented(prefix + name, info, variant, name == tells_kind)


def documented_values(settings: BaseModel) -> Iterator[tuple[KeyDoc, Any]]:
    """Iterate over the documentation and value of each setting, in the order of their definition."""
    return _values(settings, "", "", "")


def _values(section: BaseModel, prefix: str, variant: str, tells_kind: str) -> Iterator[tuple[KeyDoc, Any]]:
    for name, value in section:
        info = type(section).model_fields[name]
        if not isinstance(value, BaseModel):
            yield _documented(prefix + name, info, variant, name == tells_kind), value
            continue
        tag = next((tag for tag, section in variants_of(info).items() if section is type(value)), variant)
        told_by = info.discriminator if isinstance(info.discriminator, str) else ""
        yield from _values(value, f"{prefix}{name}.", tag, told_by)


def _documented(key: str, info: FieldInfo, variant: str, selects: bool) -> KeyDoc:
    default = None
    if not selects and (info.default_factory is not None or info.default is not PydanticUndefined):
        value = info.get_default(call_default_factory=True, validated_data={})
        default = "" if value is None else as_yaml(value)
    return KeyDoc(key, _type_name(info.annotation), default, info.description or "", variant, selects)


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
    names = {
        int: "integer",
        float: "number",
        str: "text",
        bool: "true or false",
        Path: "path",
        NoneType: "empty",
    }
    if annotation in names:
        return names[annotation]
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return " or ".join(f"`{argument}`" for argument in arguments)
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
    text = [
        "# Settings",
        "",
        "This page lists every key of `scene.yaml`. Only `tracker.kind` and `output` are required, and `source.path`",
        "for most trackers. Relative paths are relative to the scene file. An unknown key is an error that names the",
        "nearest right one. Units are in square brackets. To override a key on the command line, use `--set`:",
        "",
        "```sh",
        "modp-ti run scene.yaml --set source.scale=0.5 --set refine.steps=3000",
        "```",
        "",
        "The tables are generated: `python -m modp_ti.config > docs/configuration.md`.",
    ]
    for section, variants in sections.items():
        text += ["", f"## {f'`{section}`' if section else 'Top level'}", ""]
        if "" in variants:
            text += _table(variants[""])
            continue
        selecting = [entry for entries in variants.values() for entry in entries if entry.selects]
        key = selecting[0].key
        text += [f"Its keys depend on `{key}`, which is required:", "", f"| `{key}` | meaning |", "|---|---|"]
        text += [
            f"| [`{entry.variant}`](#{section}-of-kind-{entry.variant}) | {entry.description} |" for entry in selecting
        ]
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
