"""Reading of `scene.yaml` with overrides and a preset, and writing of the resolved settings."""

from __future__ import annotations

import difflib
import json
import os
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from modp_ti.config.keys import as_yaml, differing_keys, documented_keys, dotted_keys, suggestion
from modp_ti.config.presets import PRESETS, with_defaults
from modp_ti.config.settings import SceneConfig
from modp_ti.files import read_text, reading
from modp_ti.files.atomic import replace_text
from modp_ti.files.errors import FROM_FILE, InputError, shown_url
from modp_ti.files.terminal import require_text, shown
from modp_ti.files.yaml_text import parse_yaml
from modp_ti.inputs.source_settings import WITH_SECRETS

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
    with reading(file):
        text = read_text(file)
    lines: dict[str, int] = {}
    data = parse_yaml(text, str(file), lines)
    if not isinstance(data, dict):
        raise InputError(
            f"{file}: a scene file has keys such as `source:`, `tracker:` and `output:`; this one holds none"
        )
    where = {key: f"{file}:{line}" for key, line in lines.items()}
    return _Given(data, str(file), where).scene(overrides, preset, file.resolve().parent)


def scene_from_data(
    data: dict[str, Any], name: str, overrides: Iterable[str] = (), preset: str | None = None
) -> SceneConfig:
    """Build the settings from plain data, such as a run has stored in the file `name`.

    Overrides, preset and errors are as for `load_scene`. Relative paths are resolved against the working directory.
    """
    return _Given(json.loads(json.dumps(data)), name, {}).scene(overrides, preset, Path.cwd())


def dump_scene(config: SceneConfig, path: str | os.PathLike[str]) -> None:
    """Write every setting with absolute paths, so that the file gives the same run from any folder."""
    resolved = _with_absolute_paths(config, Path.cwd())
    text = "# Every setting of this run: `modp-ti run` on this file gives the same map.\n"
    written = resolved.model_dump(mode="json")
    for key in differing_keys(resolved.model_dump(mode="json", context=WITH_SECRETS), written, ()):
        text += (
            f"# {key} had a user, password or query: give it again, or take it with from-env:NAME (docs/sources.md).\n"
        )
    text += yaml.safe_dump(written, sort_keys=False, allow_unicode=True)
    replace_text(path, text)


class _Given:
    """Settings as plain data before their validation, with the file and line, or the override, that set each."""

    def __init__(self, data: dict[str, Any], name: str, where: dict[str, str]) -> None:
        self.data, self.name, self.where = data, name, where

    def scene(self, overrides: Iterable[str], preset: str | None, base: Path) -> SceneConfig:
        """Apply overrides, fill in the preset, validate, and resolve paths against `base`."""
        for override in overrides:
            self._override(override)
        typed = frozenset(key for key, origin in self.where.items() if origin.startswith("--set "))
        if preset is not None:
            if preset not in PRESETS:
                raise InputError(f"there is no preset {preset}: use {' or '.join(PRESETS)}")
            self.data = with_defaults(self.data, PRESETS[preset].settings)
        try:
            # Strict JSON mode rejects `scale: "0.5"` and `holdout: true` as numbers, but still accepts text as a path.
            config = SceneConfig.model_validate_json(json.dumps(self.data), strict=True)
        except ValidationError as error:
            raise InputError(self._message(error.errors())) from None
        return _with_absolute_paths(config, base, typed)

    def _override(self, override: str) -> None:
        """Write one "section.key=value" into the data."""
        key, equals, text = override.partition("=")
        key, origin = key.strip(), f"--set {key}{equals}{shown_url(text.strip())}"
        if not equals or not key:
            raise InputError(f"{origin}: write it as section.key=value, for example source.scale=0.5")
        if key not in dotted_keys(documented_keys(SceneConfig)):
            raise InputError(f"{origin}: unknown key `{key}`; {suggestion(SceneConfig, key)}")
        *sections, last = key.split(".")
        section = self.data
        for part in sections:
            if not isinstance(section.get(part), dict):
                section[part] = {}
            section = section[part]
        section[last] = parse_yaml(text, origin, {})
        for known in [k for k in self.where if k.startswith(key + ".")]:
            del self.where[known]
        self.where[key] = origin

    def _message(self, problems: list[ErrorDetails]) -> str:
        """What is wrong, in one line, from pydantic's errors: unknown keys first, which may be why others miss."""
        problems = sorted(problems, key=lambda problem: problem["type"] != "extra_forbidden")
        first, place = problems[0], self._place(problems[0])
        same = [problem for problem in problems if self._place(problem) == place]
        text = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            section = self.data.get(place.partition(".")[0])
            kind = section.get("kind", "") if isinstance(section, dict) else ""
            text = f"unknown key `{place}`; {suggestion(SceneConfig, place, str(kind))}"
        elif first["type"].startswith("union_tag"):  # the section's kind is missing or unknown
            place += "." + first.get("ctx", {})["discriminator"].strip("'")
            text = _no_such_kind(place, first)
        elif first["type"] == "missing":
            text = f"{place} is missing: {_description(place) or 'it has no default'}"
        elif first["type"] != "value_error":
            text = f"{place}: {_expected(same)}, not {as_yaml(first['input'])}"
        elif not place:  # of the whole scene, beginning with a key
            place = text.split(" ")[0].rstrip(":")
        others = len(problems) - len(same)
        while place not in self.where and "." in place:
            place = place.rpartition(".")[0]
        return f"{self.where.get(place, self.name)}: {text}{f' (and {others} more)' if others else ''}"

    def _place(self, problem: ErrorDetails) -> str:
        """The dotted key of an error, whose location also contains the kind of a section or the type of a value."""
        node, parts = cast(Any, self.data), []
        for part in problem["loc"]:
            with suppress(LookupError, TypeError):
                node = node[part]
                parts.append(str(part))
        if problem["type"] == "missing":
            parts.append(str(problem["loc"][-1]))
        return ".".join(parts)


def _expected(problems: list[ErrorDetails]) -> str:
    """What a value must be, from the errors of all types that it may have: "must be 'auto' or a valid number"."""
    # A word is no advice for a value that is not text: 7 should be less, not 'auto'.
    types = [problem for problem in problems if problem["type"] != "literal_error"]
    meant = problems if isinstance(problems[0]["input"], str) or not types else types
    texts = [problem["msg"].replace("Input should be", "must be") for problem in meant]
    return " or ".join([texts[0], *(text.removeprefix("must be ") for text in texts[1:])])


def _no_such_kind(key: str, error: ErrorDetails) -> str:
    """The message for a section whose discriminator `key` is missing or unknown, from pydantic's error."""
    if error["type"] == "union_tag_not_found":
        return f"{key} is missing: {_description(key)}"
    given = error["input"][key.rpartition(".")[2]]
    kinds = [entry.variant for entry in documented_keys(SceneConfig) if entry.key == key]
    near = difflib.get_close_matches(str(given), kinds, n=1)
    hint = f"; did you mean `{near[0]}`?" if near else ""
    return f"{key}: must be one of {', '.join(kinds)}, not {as_yaml(given)}{hint}"


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


def _with_absolute_paths(model: M, base: Path, typed: frozenset[str] = frozenset(), section: str = "") -> M:
    """Resolve paths against `base`, and those of the dotted keys or sections `typed` against the working directory."""
    update: dict[str, Any] = {}
    for name, value in model:
        here = Path.cwd() if section + name in typed else base
        if isinstance(value, Path):
            update[name] = _absolute_path(value, here, name)
        elif isinstance(value, str) and value.startswith(FROM_FILE):
            update[name] = f"{FROM_FILE}{_absolute_path(Path(value.removeprefix(FROM_FILE)), here, name)}"
        elif isinstance(value, BaseModel):
            update[name] = _with_absolute_paths(value, here, typed, f"{section}{name}.")
    return model.model_copy(update=update)


def _absolute_path(value: Path, base: Path, name: str) -> Path:
    """Resolve a path against `base`. Raises InputError for one that no file can have."""
    try:
        path = (base / value.expanduser()).resolve()
        require_text(os.fspath(path))
        return path
    except (RuntimeError, OSError, ValueError) as error:  # no such user (`~name`), a loop of links, a NUL character
        raise InputError(f"{name}: {shown(str(value))[:80]}: no file can be called that: {error}") from None
