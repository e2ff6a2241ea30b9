"""The keys of a settings model: type, default and meaning of each, the nearest right one, and what differs."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from operator import attrgetter
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from modp_ti.files.errors import shown_url
from modp_ti.inputs.reader import in_a_sentence

TYPE_NAMES = {int: "integer", float: "number", str: "text", bool: "true or false", Path: "path", NoneType: "empty"}


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
        sections = list(kinds.items()) or [(variant, section) for section in _sections_of(info.annotation)]
        for tag, section in sections:
            yield from documented_keys(section, f"{prefix}{name}.", tag, selecting)
        if not sections:
            selects, default = name == kind_key, None
            if not selects and not info.is_required():
                value = info.get_default(call_default_factory=True, validated_data={})
                default = "" if value is None else as_yaml(value)
            description = info.description or (in_a_sentence(model) if selects else "")
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
        for model in _sections_of(info.annotation)
        for tag in get_args(model.model_fields[info.discriminator].annotation)
    }


def _sections_of(annotation: Any) -> list[type[BaseModel]]:
    """The models that a field accepts: one for `Section` and `Section | None`, none for a plain value."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    arguments = get_args(annotation)
    if get_origin(annotation) in (list, tuple, dict):
        return []
    return [model for argument in arguments for model in _sections_of(argument)]


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


def suggestion(model: type[BaseModel], key: str, kind: str = "") -> str:
    """Return what to write instead of an unknown dotted key, as the end of an error message.

    Args:
        model: The settings model.
        key: The key.
        kind: The kind of its section, if that has several.
    """
    entries = list(documented_keys(model))
    if of := list(dict.fromkeys(entry.variant for entry in entries if entry.key == key and entry.variant)):
        return f"it is for {key.partition('.')[0]}.kind: {', '.join(of)}, not {kind}; take it out"
    section, _, name = key.rpartition(".")
    known = dotted_keys(entry for entry in entries if not kind or entry.variant in ("", kind))
    inside = {each.rpartition(".")[2]: each for each in known if each.rpartition(".")[0] == section}
    namesakes = [each for each in dotted_keys(entries) if each.rpartition(".")[2] == name]
    for word, words, cutoff in ((name, inside, 0.6), (key, namesakes, 0.0), (key, dotted_keys(entries), 0.6)):
        if found := get_close_matches(word, words, n=1, cutoff=cutoff):
            return f"did you mean `{inside.get(found[0], found[0])}`?"
    return f"{'this section has' if section else 'the keys are'} {', '.join(inside.values())}"


def dotted_keys(entries: Iterable[KeyDoc]) -> dict[str, None]:
    """Return the dotted names of settings and of the sections that they lie in, in order."""
    parts = (entry.key.split(".") for entry in entries)
    return dict.fromkeys(".".join(names[:end]) for names in parts for end in range(1, len(names) + 1))


def leaves(settings: Mapping[str, Any], start: str = "") -> dict[str, Any]:
    """Flatten nested settings to values by dotted key."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        flat |= leaves(value, f"{start}{key}.") if isinstance(value, Mapping) else {f"{start}{key}": value}
    return flat


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
        for key in new | old
        if old.get(key) != new.get(key) and not any(key == name or key.startswith(f"{name}.") for name in free)
    ]
