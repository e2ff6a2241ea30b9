"""Reading of `scene.yaml` with overrides, and writing of the resolved settings."""

from __future__ import annotations

import difflib
import json
import math
import os
import re
from collections.abc import Iterable, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from modp_ti.config.keys import as_yaml, documented_keys, sections_of, variants_of
from modp_ti.config.old_settings import refuse_removed_kind, without_leftovers
from modp_ti.config.presets import with_preset
from modp_ti.config.settings import SceneConfig
from modp_ti.config.unknown_keys import refuse_unknown_keys
from modp_ti.files import read_text
from modp_ti.files.atomic import replace_text
from modp_ti.files.errors import InputError

__all__ = ["dump_scene", "load_scene", "scene_from_data"]

M = TypeVar("M", bound=BaseModel)


def load_scene(path: str | os.PathLike[str], overrides: Iterable[str] = (), preset: str | None = None) -> SceneConfig:
    """Read a scene file.

    Args:
        path: The scene file (YAML).
        overrides: Settings as "section.key=value" with the value in YAML, applied in order after the file.
        preset: Name of a preset, whose settings replace defaults only: "fast" or "best". None for the defaults.

    Returns:
        The settings, with absolute paths. Relative paths of the file are resolved against its folder, and those of
        overrides, which are typed in a shell, against the working directory.

    Raises:
        InputError: With a one-line message, if the file is unreadable, a key or the preset is unknown, or a value is
            invalid.

    Examples:
        Halve the image size of a scene and change its output folder:

            config = modp_ti.load_scene("scene.yaml", ["source.scale=0.5", "output=out/half"])
    """
    file = Path(path)
    try:
        text = read_text(file)
    except FileNotFoundError:
        raise InputError(f"{file}: no such scene file") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it holds bytes that are no text"
        raise InputError(f"{file}: cannot be read as text: {reason}") from None
    if len(text) > MAX_TEXT:
        raise InputError(f"{file}: has {len(text):,} characters, which is no scene file: at most {MAX_TEXT:,}")

    lines: dict[str, int] = {}
    data = _parse_yaml(text, str(file), lines)
    if not isinstance(data, dict):
        raise InputError(
            f"{file}: a scene file has keys such as `source:`, `tracker:` and `output:`; this one holds none"
        )
    where = {key: f"{file}:{line}" for key, line in lines.items()}
    config = _resolved(data, where, str(file), overrides, preset)
    typed = frozenset(key for key, origin in where.items() if origin.startswith("--set "))
    return _with_absolute_paths(config, file.resolve().parent, typed)


def scene_from_data(
    data: dict[str, Any], name: str, overrides: Iterable[str] = (), preset: str | None = None
) -> SceneConfig:
    """Build the settings from plain data, such as a run has stored in the file `name`.

    Overrides, preset and errors are as for `load_scene`. Relative paths are resolved against the working directory.
    """
    data = json.loads(json.dumps(data))
    return _with_absolute_paths(_resolved(data, {}, name, overrides, preset), Path.cwd())


def dump_scene(config: SceneConfig, path: str | os.PathLike[str]) -> None:
    """Write every setting with absolute paths, so that the file gives the same run from any folder."""
    resolved = _with_absolute_paths(config, Path.cwd())
    text = "# Every setting of this run: `modp-ti run` on this file gives the same map.\n"
    text += yaml.safe_dump(resolved.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    replace_text(path, text)


def _with_absolute_paths(model: M, base: Path, typed: frozenset[str] = frozenset(), section: str = "") -> M:
    """Resolve paths against `base`, and those of the dotted keys or sections `typed` against the working directory."""
    update: dict[str, Any] = {}
    for name, value in model:
        here = Path.cwd() if section + name in typed else base
        if isinstance(value, Path):
            update[name] = _absolute_path(value, here, name)
        elif isinstance(value, BaseModel):
            update[name] = _with_absolute_paths(value, here, typed, f"{section}{name}.")
    return model.model_copy(update=update)


def _absolute_path(value: Path, base: Path, name: str) -> Path:
    """Resolve a path against `base`. Raises InputError for one that no file can have."""
    longest = max(len(os.fsencode(part)) for part in (*value.parts, ""))
    if "\0" in str(value) or longest > MAX_NAME or len(os.fsencode(value)) > MAX_PATH:
        shown = f"{value}".replace("\0", "")[:40]
        raise InputError(f"{name}: {shown}...: no file can be called that: it is too long, or holds a NUL character")
    try:
        return (base / value.expanduser()).resolve()
    except (RuntimeError, OSError) as error:  # no such user (`~name`), or a loop of symbolic links
        raise InputError(f"{name}: {value}: is no path: {error}") from None


def _resolved(
    data: dict[str, Any], where: dict[str, str], name: str, overrides: Iterable[str], preset: str | None = None
) -> SceneConfig:
    """Apply overrides to the raw data, fill in the preset and validate the result.

    `where` maps each dotted key to the file and line, or the override, that set it. Overrides update it.
    """
    for override in overrides:
        _apply_override(data, override, where)
    # After the overrides, since one may change `tracker.kind`, on which the keys of the section depend.
    refuse_removed_kind(data, where, name)
    data = without_leftovers(data)
    refuse_unknown_keys(data, SceneConfig, where, name)
    return _validated(with_preset(data, preset) if preset else data, where, name)


def _validated(data: dict[str, Any], where: Mapping[str, str], name: str) -> SceneConfig:
    try:
        # Strict JSON mode rejects `scale: "0.5"` and `holdout: true` as numbers, but still accepts text as a path.
        return SceneConfig.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        problems = error.errors()
        first = problems[0]
        place = _place(first["loc"])
        same = [problem for problem in problems if _place(problem["loc"]) == place]
        text = first["msg"].removeprefix("Value error, ")
        if first["type"].startswith("union_tag"):  # the section's kind is missing or unknown
            place += "." + first.get("ctx", {})["discriminator"].strip("'")
            text = _no_such_kind(place, first)
        elif first["type"] == "missing":
            text = f"{place} is missing: {_description(place) or 'it has no default'}"
        elif place and first["type"] != "value_error":
            text = f"{place}: {_expected(same)}, not {as_yaml(first['input'])}"
        others = len(problems) - len(same)
        more = f" (and {others} more)" if others else ""
        raise InputError(f"{where.get(place, name)}: {text}{more}") from None


def _expected(problems: list[ErrorDetails]) -> str:
    """What a value must be, from the errors of all types that it may have: "must be 'auto' or a valid number"."""
    # A word is no advice for a value that is not text: 7 should be less, not 'auto'.
    types = [problem for problem in problems if problem["type"] != "literal_error"]
    meant = problems if isinstance(problems[0]["input"], str) or not types else types
    texts = [problem["msg"].replace("Input should be", "must be") for problem in meant]
    return " or ".join([texts[0], *(text.removeprefix("must be ") for text in texts[1:])])


def _place(location: tuple[int | str, ...]) -> str:
    """The dotted key of a pydantic error, whose location also contains the kind of a section or the type of a value."""
    parts: list[str] = []
    fields: Mapping[str, FieldInfo] = SceneConfig.model_fields
    remaining = iter(location)
    for part in remaining:
        info = fields.get(str(part))
        if info is None:
            parts += [str(part)] if isinstance(part, int) or not parts else []
            fields = {}
            continue
        parts.append(str(part))
        variants = variants_of(info)
        sections = [variants[str(tag)] for tag in islice(remaining, 1)] if variants else sections_of(info.annotation)
        fields = sections[0].model_fields if sections else {}
    return ".".join(parts)


def _no_such_kind(key: str, error: ErrorDetails) -> str:
    """The message for a section whose discriminator `key` is missing or unknown, from pydantic's error."""
    if error["type"] == "union_tag_not_found":
        return f"{key} is missing: {_description(key)}"
    given = error["input"][key.rpartition(".")[2]]
    kinds = [entry.variant for entry in documented_keys(SceneConfig) if entry.key == key]
    near = difflib.get_close_matches(str(given), kinds, n=1, cutoff=0.6)
    hint = f"; did you mean `{near[0]}`?" if near else ""
    names = ", ".join(f"'{kind}'" for kind in kinds[:-1])
    return f"{key}: must be {names} or '{kinds[-1]}', not {as_yaml(given)}{hint}"


# Limits of a scene file: characters, YAML events, nesting depth, and characters of an integer.
MAX_TEXT, MAX_EVENTS, MAX_DEPTH, MAX_DIGITS = 1 << 18, 20_000, 16, 19
# Limits of common file systems: bytes of a name and of a path.
MAX_NAME, MAX_PATH = 255, 4095

_INT = re.compile(r"[-+]?[0-9]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")


def _parse_yaml(text: str, name: str, lines: dict[str, int]) -> Any:
    """Parse YAML 1.2 into plain data: `1e-3` is a number, `no` is text, and duplicate keys are errors.

    `lines` is filled with the line (from 1) of every dotted key.
    """
    try:
        _require_flat(text, name)
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        return None if node is None else _plain(node, "", name, lines)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{name}:{mark.line + 1}" if mark else name
        raise InputError(f"{place}: not valid YAML: {error.problem or error.context}") from None
    except yaml.YAMLError as error:
        raise InputError(f"{name}: not valid YAML: {' '.join(str(error).split())}") from None


def _require_flat(text: str, name: str) -> None:
    """Raise InputError for YAML that is too deep or too large, before its tree is built.

    Aliases are refused, because a few lines of them can expand to any number of values.
    """
    depth = count = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        count += 1
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent):
            raise InputError(f"{name}:{line}: an alias (*{event.anchor:.40}) is not taken here: write the value out")
        if depth > MAX_DEPTH or count > MAX_EVENTS:
            raise InputError(f"{name}:{line}: deeper or longer than any scene file")


def _plain(node: yaml.Node, place: str, name: str, lines: dict[str, int]) -> Any:
    line = node.start_mark.line + 1
    if isinstance(node, yaml.MappingNode):
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key_line = key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode):
                raise InputError(f"{name}:{key_line}: a key must be a word")
            key = str(key_node.value)
            inner = f"{place}.{key}" if place else key
            if key in result:
                raise InputError(f"{name}:{key_line}: `{inner}` stands twice (first in line {lines[inner]})")
            lines[inner] = key_line
            result[key] = _plain(value_node, inner, name, lines)
        return result
    if isinstance(node, yaml.SequenceNode):
        return [_plain(item, f"{place}.{i}", name, lines) for i, item in enumerate(node.value)]
    value = str(node.value)
    if isinstance(node, yaml.ScalarNode) and node.style is not None:  # quoted or block text
        return value
    if value in ("", "~", "null", "Null", "NULL"):
        return None
    if value in ("true", "True", "TRUE", "false", "False", "FALSE"):
        return value[0] in "tT"
    if _INT.fullmatch(value) and len(value) <= MAX_DIGITS:
        return int(value)
    if _FLOAT.fullmatch(value) and math.isfinite(float(value)):
        return float(value)
    if _FLOAT.fullmatch(value) or value.lstrip("+-").lower() in (".inf", ".nan"):
        raise InputError(f"{name}:{line}: {place or 'the value'}: must be a finite number, not {value}")
    return value


def _apply_override(data: dict[str, Any], override: str, where: dict[str, str]) -> None:
    """Write one "section.key=value" into the raw data."""
    origin = f"--set {override}"
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not key:
        raise InputError(f"{origin}: write it as section.key=value, for example source.scale=0.5")
    value = _parse_yaml(text, origin, {})

    parts = key.split(".")
    nested: dict[str, Any] = {parts[-1]: value}
    for part in reversed(parts[:-1]):
        nested = {part: nested}
    refuse_unknown_keys(nested, SceneConfig, {}, origin, whole_key=key)

    section = data
    for part in parts[:-1]:
        if not isinstance(section.get(part), dict):
            section[part] = {}
        section = section[part]
    section[parts[-1]] = value
    for known in [k for k in where if k == key or k.startswith(key + ".")]:
        del where[known]
    where[key] = origin


def _description(key: str) -> str:
    """The meaning of a key; for a section, its required keys."""
    keys = list(documented_keys(SceneConfig))
    found = [entry for entry in keys if entry.key == key]
    if found and found[0].selects:
        return "one of " + ", ".join(f"`{entry.variant}` ({entry.description})" for entry in found)
    if found:
        return f"{found[0].description} ({found[0].type})"
    needed = dict.fromkeys(entry.key for entry in keys if entry.key.startswith(key + ".") and entry.default is None)
    return f"it needs {', '.join(needed)}" if needed else ""
