"""The keys of a configuration model: what each is called, takes and means, and the page that tells it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

__all__ = ["KeyDoc", "as_yaml", "documented_keys", "markdown_of_keys", "sections_of"]


def as_yaml(value: Any) -> str:
    """A value as YAML text on one line."""
    return json.dumps(value, ensure_ascii=False, default=str)


@dataclass(frozen=True)
class KeyDoc:
    """One setting: dotted key, type, default as YAML text (None where the key is required), meaning."""

    key: str
    type: str
    default: str | None
    description: str


def documented_keys(model: type[BaseModel], prefix: str = "") -> Iterator[KeyDoc]:
    """Every setting of a model in its order; prefix: of the dotted keys."""
    for name, info in model.model_fields.items():
        sections = sections_of(info.annotation)
        if sections:
            for section in sections:
                yield from documented_keys(section, f"{prefix}{name}.")
            continue
        default = None
        if info.default_factory is not None or info.default is not PydanticUndefined:
            value = info.get_default(call_default_factory=True, validated_data={})
            default = "" if value is None else as_yaml(value)
        yield KeyDoc(prefix + name, _type_name(info.annotation), default, info.description or "")


def sections_of(annotation: Any) -> list[type[BaseModel]]:
    """The models that a field can hold: one for `Section` and `Section | None`, none for a plain value."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    arguments = get_args(annotation)
    if getattr(annotation, "__origin__", None) in (list, tuple, dict):
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
    origin, arguments = getattr(annotation, "__origin__", None), get_args(annotation)
    if origin is Literal:
        return " or ".join(f"`{argument}`" for argument in arguments)
    if origin in (list, tuple):
        return "list of " + _type_name(arguments[0])
    if arguments:
        return " or ".join(_type_name(argument) for argument in arguments)
    return getattr(annotation, "__name__", str(annotation))


def markdown_of_keys(model: type[BaseModel]) -> str:
    """The reference of all keys as Markdown tables, one a section."""
    sections: dict[str, list[KeyDoc]] = {}
    for entry in documented_keys(model):
        sections.setdefault(entry.key.rpartition(".")[0], []).append(entry)
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
    for section, entries in sections.items():
        text += ["", f"## {f'`{section}`' if section else 'Top level'}", ""]
        text += ["| key | type | default | meaning |", "|---|---|---|---|"]
        for entry in entries:
            default = "required" if entry.default is None else f"`{entry.default}`" if entry.default else "empty"
            cells = [f"`{entry.key}`", entry.type, default, entry.description]
            text.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(text) + "\n"
