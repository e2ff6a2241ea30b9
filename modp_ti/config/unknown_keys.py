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
    data: Mapping[str, Any], model: type[BaseModel], where: Mapping[str, str], origin: str, whole_key: str | None = None
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
        fields: dict[str, FieldInfo] = {}
        elsewhere: dict[str, list[str]] = {}  # keys of the kinds that the data do not name, with these kinds
        for name, model in variants.items():
            if name == kind or kind not in variants:
                fields |= model.model_fields
                continue
            for key in model.model_fields:
                elsewhere.setdefault(key, []).append(name)
        for key, value in data.items():
            place = prefix + key
            if key in elsewhere and key not in fields:
                *before, last = elsewhere[key]
                kinds = f"{', '.join(before)} and {last}" if before else last
                own = ", ".join(f"`{prefix}{name}`" for name in fields if name != told_by)
                hint = f": it is for {prefix}{told_by}: {kinds}, not {kind}, which has {own}; take it out"
                raise InputError(f"{self._written(place)}: unknown key `{place}`{hint}")
            if key not in fields:
                others = {name: f"{prefix}{told_by}: {kinds[-1]}" for name, kinds in elsewhere.items()}
                raise InputError(
                    f"{self._written(place)}: unknown key `{place}`; {self._nearest(key, prefix, list(fields), others)}"
                )
            if isinstance(value, Mapping):
                self._check_below(value, fields[key], place)

    def _check_below(self, value: Mapping[str, Any], info: FieldInfo, place: str) -> None:
        sections = sections_of(info.annotation)
        if variants := variants_of(info):
            self.check(value, variants, str(info.discriminator), f"{place}.")
        elif not sections and self.whole_key is not None:
            raise InputError(f"{self.origin}: `{place}` is a value, it has no keys of its own")
        elif len(sections) == 1:
            self.check(value, {"": sections[0]}, "", f"{place}.")

    def _written(self, place: str) -> str:
        """The place that set the key, or the nearest enclosing section that has one."""
        while place not in self.where and "." in place:
            place = place.rpartition(".")[0]
        return self.where.get(place, self.origin)

    def _nearest(self, key: str, prefix: str, own: list[str], others: Mapping[str, str]) -> str:
        """Suggest a key of the section, or of its `others` kinds, or of the whole model; or list the section's keys."""
        place = prefix + key
        if found := _closest(key, own):
            found = prefix + found
            if self.whole_key not in (None, place):  # the name of a section is wrong: suggest the key below it
                below = [other for other in self.every if other.startswith(found)]
                found = _closest(self.whole_key or "", below, 0.0) or found
            return f"did you mean `{found}`?"
        if found := _closest(key, list(others)):
            return f"did you mean `{prefix}{found}`, which is for {others[found]}?"
        same_leaf = (other for other in self.every if other.rpartition(".")[2] == key)
        if found := next(same_leaf, None) or _closest(self.whole_key or place, self.every):
            return f"did you mean `{found}`?"
        return f"{'this section has' if prefix else 'the keys are'} {', '.join(prefix + name for name in own)}"


def _closest(word: str, words: Sequence[str], cutoff: float = 0.6) -> str | None:
    return next(iter(difflib.get_close_matches(word, words, n=1, cutoff=cutoff)), None)
