"""`frames.json`: facts about a run that later commands need and no other file contains."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import NO_ORIGIN
from fields.geometry.camera import PinholeCamera
from modp_ti.files import read_json
from modp_ti.files.atomic import replace_text
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.inputs.sources.intrinsics import Intrinsics, require_plausible
from modp_ti.inputs.sources.undistortion import Undistorter

__all__ = ["FramesRecord", "read_frames", "write_frames"]

# The parts of a lens that are always written.
LENS = ("numerator", "denominator", "tangential", "fisheye")


@dataclass(frozen=True)
class FramesRecord:
    """Content of `frames.json`.

    Attributes:
        near: Depth below which nothing is drawn [scene units].
        scene_depth: Median depth of the keyframes' views [scene units].
        keyframes: Ascending positions of the keyframes in trajectory.txt.
        held_out: Ascending positions of the held-out frames in trajectory.txt.
        stored_camera: Camera of the images as stored, before they were undistorted and scaled, of the first frame;
            None if it is not known.
        origin: Where the origin of the splats lies in the world of trajectory.txt and colmap/ (3,).
    """

    near: float
    scene_depth: float
    keyframes: list[int]
    held_out: list[int]
    stored_camera: Intrinsics | None = None
    origin: NDArray[np.float64] = field(default_factory=lambda: NO_ORIGIN)


def write_frames(
    path: Path,
    near: float,
    scene_depth: float,
    keyframes: Collection[int],
    held_out: Collection[int],
    undistorter: Undistorter | None = None,
    origin: NDArray[np.float64] = NO_ORIGIN,
) -> None:
    """Write the record, with `undistorter` that of the first frame's image. Numbers are read back exactly."""
    record: dict[str, Any] = {
        "near": float(near),
        "scene_depth": float(scene_depth),
        "keyframes": sorted(keyframes),
        "held_out": sorted(held_out),
    }
    if undistorter is not None:
        lens = asdict(undistorter.distortion)
        lens = {name: value for name, value in lens.items() if name in LENS or value != asdict(NO_DISTORTION)[name]}
        record["stored_camera"] = asdict(undistorter.raw) | {"distortion": lens}
    if origin.any():
        record["origin"] = origin.tolist()
    text = ",\n ".join(f'"{name}": {json.dumps(value)}' for name, value in record.items())
    replace_text(path, f"{{{text}}}\n")


def read_frames(path: Path, count: int) -> FramesRecord:
    """Read the record of a run of `count` frames.

    Raises:
        InputError: If the file is damaged or does not fit `count`.
    """
    try:
        data = read_json(path, "of a finished run")
        record = FramesRecord(
            float(data["near"]),
            float(data["scene_depth"]),
            list(data["keyframes"]),
            list(data["held_out"]),
            _stored_camera(data["stored_camera"], path) if "stored_camera" in data else None,
            np.array(data.get("origin", NO_ORIGIN), dtype=np.float64).reshape(3),
        )
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as what a run says of its frames: {error!r:.80}") from None
    indices = [*record.keyframes, *record.held_out]
    if not np.isfinite(record.origin).all():
        raise InputError(f"{path}: origin must be three finite numbers")
    if not (0 < record.near < math.inf and 0 < record.scene_depth < math.inf and record.keyframes):
        raise InputError(f"{path}: near and scene_depth must be positive, and keyframes must name some")
    if not all(type(index) is int and 0 <= index < count for index in indices):
        raise InputError(f"{path}: names frames beyond the {count} that trajectory.txt has")
    return record


def _stored_camera(data: Mapping[str, Any], path: Path) -> Intrinsics:
    lens = data["distortion"]
    numerator, denominator = (tuple(map(float, lens[name])) for name in ("numerator", "denominator"))
    p1, p2 = map(float, lens["tangential"])
    fx, fy, cx, cy = (float(data[name]) for name in ("fx", "fy", "cx", "cy"))
    camera = PinholeCamera(fx, fy, cx, cy, int(data["width"]), int(data["height"]))
    more = {name: value for name, value in lens.items() if name not in LENS}
    s1, s2, s3, s4 = map(float, more.pop("prism", NO_DISTORTION.prism))
    distortion = Distortion(numerator, denominator, (p1, p2), bool(lens["fisheye"]), (s1, s2, s3, s4), **more)
    return Intrinsics(*require_plausible(camera, distortion, f"{path}: stored_camera"))
