"""Errors for unknown keys in settings, with the place of the key and the nearest valid one."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from modp_ti.config.keys import documented_keys, sections_of, variants_of
from modp_ti.files.errors import InputError

__all__ = ["refuse_unknown_keys"]


def refuse_unknown_keys(
    data: Mapping[str, Any],
    model: type[BaseModel],
    where: Mapping[str, str],
    origin: str,
    whole_key: str | None = None,
) -> None:
    """Raise an error for the first key that the model does not have, and suggest the nearest valid one.

    Args:
        data: Settings as plain data, before validation. A section with several kinds is compared with the kind that it
            names, or with all kinds if it names none.
        model: The settings model.
        where: File and line, or the override, that set each dotted key.
        origin: Place to name for keys that are not in `where`.
        whole_key: The dotted key of an override, which is compared as a whole with all dotted keys.

    Raises:
        InputError: If a key is unknown, or an override sets a key below a plain value.
    """
    refusal = _Refusal(where, origin, whole_key, list(dict.fromkeys(entry.key for entry in documented_keys(model))))
    refusal.check(data, {"": model}, "", "")


@dataclass(frozen=True)
class _Section:
    """A section with the kind that its data name.

    Attributes:
        prefix: Prefix of its dotted keys.
        told_by: The key that selects its kind; empty if it has no kinds.
        kind: The kind that the data name; empty if they name none.
        fields: Valid keys.
        others: Models of the other kinds, by kind.
    """

    prefix: str
    told_by: str
    kind: str
    fields: Mapping[str, FieldInfo]
    others: Mapping[str, type[BaseModel]]


@dataclass(frozen=True)
class _Refusal:
    """The check of one set of settings; `every` has all dotted keys of the whole model."""

    where: Mapping[str, str]
    origin: str
    whole_key: str | None
    every: Sequence[str]

    def check(
        self, data: Mapping[str, Any], variants: Mapping[str, type[BaseModel]], told_by: str, prefix: str
    ) -> None:
        """Check a section against `variants`, its possible models by the value of its key `told_by`."""
        named = data.get(told_by)
        kind = named if isinstance(named, str) and named in variants else ""
        chosen = {kind: variants[kind]} if kind in variants else variants
        fields = {name: info for model in chosen.values() for name, info in model.model_fields.items()}
        others = {name: model for name, model in variants.items() if name not in chosen}
        section = _Section(prefix, told_by, kind, fields, others)
        for key, value in data.items():
            place = prefix + key
            if key not in fields:
                hint = _of_another_kind(key, section) or self._nearest(key, section)
                raise InputError(f"{self._written(place)}: unknown key `{place}`{hint}")
            if isinstance(value, Mapping):
                self._check_below(value, fields[key], place)

    def _check_below(self, value: Mapping[str, Any], info: FieldInfo, place: str) -> None:
        if variants := variants_of(info):
            self.check(value, variants, str(info.discriminator), f"{place}.")
            return
        sections = sections_of(info.annotation)
        if not sections and self.whole_key is not None:
            raise InputError(f"{self.origin}: `{place}` is a value, it has no keys of its own")
        if len(sections) == 1:
            self.check(value, {"": sections[0]}, "", f"{place}.")

    def _written(self, place: str) -> str:
        """The place that set the key, or the nearest enclosing section that has one."""
        while place not in self.where and "." in place:
            place = place.rpartition(".")[0]
        return self.where.get(place, self.origin)

    def _nearest(self, key: str, section: _Section) -> str:
        prefix, whole_key = section.prefix, self.whole_key
        place = prefix + key
        elsewhere = {name: kind for kind, model in section.others.items() for name in model.model_fields}
        in_section = difflib.get_close_matches(key, list(section.fields), n=1, cutoff=0.6)
        in_others = difflib.get_close_matches(key, list(elsewhere), n=1, cutoff=0.6)
        same_leaf = [other for other in self.every if other.rpartition(".")[2] == key]
        whole = difflib.get_close_matches(whole_key or place, self.every, n=1, cutoff=0.6)
        if in_section:
            found = prefix + in_section[0]
            if whole_key is not None and whole_key != place:  # the name of a section is wrong: suggest the key below it
                keys_below = [other for other in self.every if other.startswith(found)]
                below = difflib.get_close_matches(whole_key, keys_below, n=1, cutoff=0)
                found = below[0] if below else found
        elif in_others:
            kind = f"{prefix}{section.told_by}: {elsewhere[in_others[0]]}"
            return f"; did you mean `{prefix}{in_others[0]}`, which is for {kind}?"
        elif same_leaf:
            found = same_leaf[0]
        elif whole:
            found = whole[0]
        else:
            keys = ", ".join(prefix + name for name in section.fields)
            return f"; {'this section has' if prefix else 'the keys are'} {keys}"
        return f"; did you mean `{found}`?"


def _of_another_kind(key: str, section: _Section) -> str:
    """The hint for a key that other kinds of the section have; empty if none has it."""
    having = [kind for kind, model in section.others.items() if key in model.model_fields]
    if not having:
        return ""
    kinds = having[0] if len(having) == 1 else f"{', '.join(having[:-1])} and {having[-1]}"
    own = [f"`{section.prefix}{name}`" for name in section.fields if name != section.told_by]
    return (
        f": it is for {section.prefix}{section.told_by}: {kinds}, not {section.kind}, which has "
        f"{', '.join(own) or 'no other key'}; take it out"
    )
