"""`scene.yaml`: one strict model of every setting, read from YAML with overrides, written resolved.

`python -m modp_ti.config` prints the documentation of every key as Markdown.
"""

from __future__ import annotations

import difflib
import json
import math
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from modp_ti.config_keys import as_yaml, documented_keys, markdown_of_keys, sections_of
from modp_ti.errors import InputError
from pipelines.settings import MappingSettings, OfflineSettings, RefineSettings, StrictModel

__all__ = [
    "EvaluationSettings",
    "IntrinsicsSettings",
    "SceneConfig",
    "SourceSettings",
    "TrackerSettings",
    "VrsSettings",
    "dump_scene",
    "load_scene",
]


# Trackers that bring cameras, and those whose files hold poses alone.
WITH_CAMERAS = ("colmap", "transforms", "synthetic")
WITHOUT_POINTS = ("tum", "orbslam3", "replica", "sevenscenes")
# Trackers that need nothing but images, and so can follow a camera.
LIVE_TRACKERS = ("klt",)


class IntrinsicsSettings(StrictModel):
    """The camera's calibration, for the stored size of the images."""

    fx: float | None = Field(
        None,
        gt=0,
        description="focal length in pixels of the stored images; this section wins over what the source itself says "
        "of its camera. Empty for no such section",
    )
    fy: float | None = Field(None, gt=0, description="vertical focal length; empty for fx")
    cx: float | None = Field(
        None,
        description="principal point; pixel centres lie at +0.5, so add 0.5 to what OpenCV or ROS calibrated. "
        "Empty for the middle",
    )
    cy: float | None = Field(None, description="as cx")
    k1: float = Field(0.0, description="radial distortion, as in OpenCV")
    k2: float = Field(0.0, description="as k1")
    p1: float = Field(0.0, description="tangential distortion, as in OpenCV")
    p2: float = Field(0.0, description="as p1")
    k3: float = Field(0.0, description="as k1")
    k4: float = Field(0.0, description="as k1; with `fisheye` only")
    fisheye: bool = Field(False, description="k1 to k4 are those of OpenCV's fisheye model")
    width: int | None = Field(
        None, ge=1, description="width that this calibration is for; the images are then checked against it"
    )
    height: int | None = Field(None, ge=1, description="as width")

    @property
    def given(self) -> bool:
        return self.fx is not None

    @model_validator(mode="after")
    def _one_model(self) -> IntrinsicsSettings:
        if not self.given and self.model_fields_set - {"fx"} and self != IntrinsicsSettings():
            raise ValueError("source.intrinsics.fx is missing: the focal length in pixels of the stored images")
        if self.fisheye and (self.p1 or self.p2):
            raise ValueError("source.intrinsics: OpenCV's fisheye model has no p1 and p2; take them out")
        if self.k4 and not self.fisheye:
            raise ValueError("source.intrinsics.k4 is for `fisheye: true` alone; take it out")
        if (self.width is None) != (self.height is None):
            raise ValueError("source.intrinsics: give width and height, or neither")
        return self


class VrsSettings(StrictModel):
    """The pinhole camera that Aria's fisheye images are undistorted to."""

    width: int = Field(800, ge=8, description="width of the undistorted image (Aria VRS only)")
    height: int = Field(800, ge=8, description="height of the undistorted image (Aria VRS only)")
    focal: float = Field(400.0, gt=0, description="its focal length in pixels; 400 at 800x800 sees 90 degrees")


class SourceSettings(StrictModel):
    """Where the frames are."""

    kind: Literal["auto", "images", "video", "live", "tum_rgbd", "replica", "sevenscenes", "release", "vrs"] = Field(
        "auto",
        description="what `path` or `stream` is; `auto` recognises it. `images`: a folder of images; `release`: the "
        "folder of an Aria sequence as the paper's authors publish it; `vrs`: a Project Aria recording",
    )
    path: Path | None = Field(
        None,
        description="folder of the images (subfolders are searched too), data set, video file or recording "
        "(not used by `synthetic`)",
    )
    stream: int | str | None = Field(
        None, description="number of a camera, or URL of a stream, in the place of `path`: frames are taken live"
    )
    intrinsics: IntrinsicsSettings = IntrinsicsSettings()
    vrs: VrsSettings = VrsSettings()
    scale: float = Field(1.0, gt=0, le=1, description="factor on width and height of every frame")
    holdout: int | None = Field(
        None, ge=2, description="n sets aside frames 0, n, 2n, ... for evaluation; empty for none"
    )
    fps: float = Field(
        30.0,
        gt=0,
        description="frames per second: time stamp = position in the folder / fps, where the source has no times",
    )
    start: int = Field(0, ge=0, description="first frame, as position in the folder")
    stop: int | None = Field(None, ge=1, description="position after the last frame; empty for all")
    step: int = Field(1, ge=1, description="every n-th frame")
    masks: Path | None = Field(
        None,
        description="folder with one mask an image, of its name and size: white valid, black ignored; empty for none",
    )
    mask_colour: tuple[int, int, int] | None = Field(
        None, description="[red, green, blue] (0-255): pixels of this colour are ignored; empty for none"
    )
    mask_tolerance: int = Field(
        0, ge=0, le=255, description="difference per channel up to which a pixel has mask_colour; some 10 for JPEG"
    )
    prefetch: int = Field(
        4,
        ge=0,
        description="frames that a thread decodes, undistorts and halves ahead of the mapper; 0 for no thread. "
        "The map is the same",
    )
    vignette: Path | None = Field(
        None,
        description="image of how much light reaches each pixel, brightest where all does; with `vrs` Aria's "
        "vignetting mask, of the recorded image; empty for none, or for the source's own",
    )

    @field_validator("mask_colour")
    @classmethod
    def _colour_has_8_bits(cls, colour: tuple[int, int, int] | None) -> tuple[int, int, int] | None:
        if colour is not None and not all(0 <= value <= 255 for value in colour):
            raise ValueError(f"source.mask_colour must be three numbers from 0 to 255, not {list(colour)}")
        return colour

    @model_validator(mode="after")
    def _one_place(self) -> SourceSettings:
        if self.stream is None and self.kind == "live":
            raise ValueError("source.stream is missing: `source.kind: live` needs a camera number or a URL")
        if self.stream is not None and self.kind not in ("auto", "live"):
            raise ValueError(f"source.stream is for `source.kind: live`, not {self.kind}; take one of them out")
        if self.stream is not None and self.path is not None:
            raise ValueError("source.path and source.stream cannot both be given; take one of them out")
        return self

    @model_validator(mode="after")
    def _range_is_not_empty(self) -> SourceSettings:
        if self.stop is not None and self.stop <= self.start:
            raise ValueError(f"source.stop ({self.stop}) must be larger than source.start ({self.start})")
        return self


class TrackerSettings(StrictModel):
    """Where the camera poses and the sparse points come from."""

    kind: Literal[
        "colmap",
        "transforms",
        "tum",
        "orbslam3",
        "stella_vslam",
        "aria",
        "modp",
        "replica",
        "sevenscenes",
        "synthetic",
    ] = Field(
        description="`colmap` (a model), `transforms` (transforms.json), `tum` (any trajectory in TUM's format), "
        "`orbslam3`, `stella_vslam` (its map.msg), `aria` (what MPS writes), `modp` (the paper's release), `replica`, "
        "`sevenscenes` or `synthetic` (the embedded demo)"
    )
    path: Path | None = Field(
        None,
        description="model folder or file; empty: the file of the kind's usual name near the images",
    )
    points: Path | None = Field(
        None,
        description="world points for `tum`, `orbslam3`, `replica` and `sevenscenes`: PLY, or text with `x y z` a "
        "line; empty to have features tracked and triangulated with the poses",
    )
    max_points: int = Field(
        2000, ge=10, description="points of a point file, or of MPS, that one frame is shown at most"
    )
    max_difference: float = Field(
        0.02, gt=0, description="seconds by which a pose's time may differ from its image's time"
    )
    time_offset: float = Field(
        0.0, description="seconds added to the times of the poses, where their clock is not that of the images"
    )
    camera: str = Field("camera-rgb", description="`aria` only: label of the camera in online_calibration.jsonl")
    max_inv_dist_std: float = Field(
        0.005, gt=0, description="`aria` only: points whose inverse distance is less certain [1/m] are left out"
    )
    max_dist_std: float = Field(
        0.05, gt=0, description="`aria` only: points whose distance is less certain [m] are left out"
    )
    exposure_change: float = Field(
        0.0, ge=0, description="`synthetic` only: how much its exposure wanders; at 1 by a factor of 1.3 up and down"
    )


class EvaluationSettings(StrictModel):
    """How the finished map is scored."""

    lpips_weights: Path | None = Field(
        None,
        description="folder with `alexnet-owt-7be5be79.pth` (torchvision) and `alex.pth` (the `lpips` package, v0.1); "
        "empty: torch's cache and the installed package; LPIPS is null where they are not",
    )


class SceneConfig(StrictModel):
    """Everything that a run depends on."""

    source: SourceSettings = SourceSettings()
    tracker: TrackerSettings
    output: Path = Field(description="folder of the results, made where it is missing")
    device: Literal["cpu", "cuda", "auto"] = Field("auto", description="`auto` takes CUDA where there is a GPU")
    mode: Literal["online", "offline"] = Field(
        "online",
        description="`online` maps while frames arrive and then refines; `offline` is 3DGS on all frames at once",
    )
    seed: int = Field(0, ge=0, description="seed of all randomness")
    threads: int | None = Field(None, ge=1, description="CPU threads; empty for one per core")
    mapping: MappingSettings = MappingSettings()
    refine: RefineSettings = RefineSettings()
    offline: OfflineSettings = OfflineSettings()
    evaluation: EvaluationSettings = EvaluationSettings()

    @model_validator(mode="after")
    def _images_are_named(self) -> SceneConfig:
        if self.source.path is None and self.source.stream is None and self.tracker.kind != "synthetic":
            raise ValueError("source.path is missing: give the folder that holds the images")
        if self.source.intrinsics.given and self.tracker.kind in WITH_CAMERAS:
            raise ValueError(f"tracker.kind: {self.tracker.kind} brings its own cameras; take source.intrinsics out")
        if self.source.stream is not None and self.tracker.kind not in LIVE_TRACKERS:
            raise ValueError(f"tracker.kind: {self.tracker.kind} cannot follow source.stream: it knows past images")
        if self.tracker.points is not None and self.tracker.kind not in WITHOUT_POINTS:
            raise ValueError(f"tracker.kind: {self.tracker.kind} brings its own points; take tracker.points out")
        if self.tracker.exposure_change and self.tracker.kind != "synthetic":
            raise ValueError("tracker.exposure_change is for tracker.kind: synthetic alone; take it out")
        return self


def load_scene(path: str | os.PathLike[str], overrides: Iterable[str] = ()) -> SceneConfig:
    """Reads a scene file; `overrides` are "section.key=value" with the value in YAML, applied in their order.

    Relative paths, those of overrides included, are relative to the scene file's folder; the result holds
    absolute paths. Raises InputError (one line) for an unreadable file, an unknown key or a wrong value.
    """
    file = Path(path)
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{file}: no such scene file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: cannot be read as text: {error}") from None

    lines: dict[str, int] = {}
    data = _parse_yaml(text, str(file), lines)
    if not isinstance(data, dict):
        raise InputError(
            f"{file}: a scene file has keys such as `source:`, `tracker:` and `output:`; this one holds none"
        )
    where = {key: f"{file}:{line}" for key, line in lines.items()}
    _refuse_unknown_keys(data, SceneConfig, where, str(file))
    for override in overrides:
        _apply_override(data, override, where)
    config = _validated(data, where, str(file))
    return _with_absolute_paths(config, file.resolve().parent)


def dump_scene(config: SceneConfig, path: str | os.PathLike[str]) -> None:
    """Writes every setting with absolute paths, so that the file gives the same run from wherever it lies."""
    resolved = _with_absolute_paths(config, Path.cwd())
    text = "# Every setting of this run: `modp-ti run` on this file gives the same map.\n"
    text += yaml.safe_dump(resolved.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    target = Path(path)
    partial = target.with_name(target.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, target)


def _with_absolute_paths(model: Any, base: Path) -> Any:
    update: dict[str, Any] = {}
    for name in type(model).model_fields:
        value = getattr(model, name)
        if isinstance(value, Path):
            update[name] = (base / value.expanduser()).resolve()
        elif isinstance(value, BaseModel):
            update[name] = _with_absolute_paths(value, base)
    return model.model_copy(update=update)


def _validated(data: dict[str, Any], where: Mapping[str, str], name: str) -> SceneConfig:
    """The model of the raw data. where: file and line, or the override, that wrote a dotted key."""
    try:
        # Strict JSON keeps `scale: "0.5"` and `holdout: true` from passing as numbers, and still takes text
        # as path.
        return SceneConfig.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        problems = error.errors()
        first = problems[0]
        place = ".".join(str(part) for part in first["loc"])
        text = first["msg"].removeprefix("Value error, ")
        if first["type"] == "missing":
            text = f"{place} is missing: {_description(place) or 'it has no default'}"
        elif place and first["type"] != "value_error":
            text = f"{place}: {text.replace('Input should be', 'must be')}, not {as_yaml(first['input'])}"
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise InputError(f"{where.get(place, name)}: {text}{more}") from None


_INT = re.compile(r"[-+]?[0-9]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")


def _parse_yaml(text: str, name: str, lines: dict[str, int]) -> Any:
    """Plain data of a YAML text under the YAML 1.2 rules: `1e-3` is a number, `no` is text, keys are unique.

    lines: filled with the line (from 1) of every dotted key.
    """
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        return None if node is None else _plain(node, "", name, lines)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{name}:{mark.line + 1}" if mark else name
        raise InputError(f"{place}: not valid YAML: {error.problem or error.context}") from None
    except yaml.YAMLError as error:
        raise InputError(f"{name}: not valid YAML: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise InputError(f"{name}: not valid here: an alias that holds itself") from None


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
    if node.style is not None:  # quoted or block text
        return value
    if value in ("", "~", "null", "Null", "NULL"):
        return None
    if value in ("true", "True", "TRUE", "false", "False", "FALSE"):
        return value[0] in "tT"
    if _INT.fullmatch(value):
        return int(value)
    number = None
    if _FLOAT.fullmatch(value):
        number = float(value)
    elif value.lstrip("+-").lower() in (".inf", ".nan"):
        number = math.inf
    if number is not None:
        if not math.isfinite(number):
            raise InputError(f"{name}:{line}: {place or 'the value'}: must be a finite number, not {value}")
        return number
    return value


def _apply_override(data: dict[str, Any], override: str, where: dict[str, str]) -> None:
    """Puts one "section.key=value" into the raw data."""
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
    _refuse_unknown_keys(nested, SceneConfig, {}, origin, whole_key=key)

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
    """What a key means; for a section, the keys that it needs."""
    keys = list(documented_keys(SceneConfig))
    for entry in keys:
        if entry.key == key:
            return f"{entry.description} ({entry.type})"
    needed = [entry.key for entry in keys if entry.key.startswith(key + ".") and entry.default is None]
    return f"it needs {', '.join(needed)}" if needed else ""


def _refuse_unknown_keys(
    data: Mapping[str, Any],
    model: type[BaseModel],
    where: Mapping[str, str],
    origin: str,
    prefix: str = "",
    whole_key: str | None = None,
) -> None:
    """Raises InputError for the first key that the model does not have, with the nearest one that it has.

    whole_key: the dotted key of an override, compared as a whole with all dotted keys.
    """
    for key, value in data.items():
        place = prefix + key
        if key not in model.model_fields:
            hint = _nearest(place, prefix, model, whole_key)
            raise InputError(f"{where.get(place, origin)}: unknown key `{place}`{hint}")
        sections = sections_of(model.model_fields[key].annotation)
        if not isinstance(value, Mapping):
            continue
        if not sections and whole_key is not None:
            raise InputError(f"{origin}: `{place}` is a value, it has no keys of its own")
        if len(sections) == 1:
            _refuse_unknown_keys(value, sections[0], where, origin, f"{place}.", whole_key)


def _nearest(place: str, prefix: str, model: type[BaseModel], whole_key: str | None) -> str:
    siblings = [prefix + name for name in model.model_fields]
    every = [entry.key for entry in documented_keys(SceneConfig)]
    leaf = place.removeprefix(prefix)
    in_section = difflib.get_close_matches(leaf, list(model.model_fields), n=1, cutoff=0.6)
    same_leaf = [key for key in every if key.rpartition(".")[2] == leaf]
    whole = difflib.get_close_matches(whole_key or place, every, n=1, cutoff=0.6)
    if in_section:
        found = prefix + in_section[0]
        if whole_key is not None and whole_key != place:  # the wrong part is a section: name the key below it
            below = difflib.get_close_matches(whole_key, [k for k in every if k.startswith(found)], n=1, cutoff=0)
            found = below[0] if below else found
    elif same_leaf:
        found = same_leaf[0]
    elif whole:
        found = whole[0]
    else:
        return f"; {'this section has' if prefix else 'the keys are'} {', '.join(siblings)}"
    return f"; did you mean `{found}`?"


if __name__ == "__main__":
    print(markdown_of_keys(SceneConfig), end="")
