"""The files of a run that later commands read again: the map, its frames, their exposures, masks and scores."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import NO_ORIGIN, shifted_poses
from fields.geometry.camera import PinholeCamera
from fields.map.keyframes import KeyframeStore
from modp_ti.files import LARGEST, input_lines, read_bytes, read_json, reading
from modp_ti.files.atomic import replace_text, replacing
from modp_ti.files.errors import InputError
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.inputs.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.inputs.sources.image_pixels import decoded_as
from modp_ti.inputs.sources.undistortion import Intrinsics, Undistorter, require_plausible
from modp_ti.outputs.evaluation import FrameScore, MapVersion
from modp_ti.outputs.formats.dataset import write_colmap
from modp_ti.outputs.formats.splats_ply import write_splats
from modp_ti.outputs.formats.trajectory import write_trajectory
from pipelines.render.formulas import IDENTITY

NOT_ALWAYS = ("colmap", "exposure.json", "masks")
"""What `write_map` writes that another map may lack, or have other files in."""

# The parts of a lens that are always written.
LENS = ("numerator", "denominator", "tangential", "fisheye")
COLUMNS = [field.name for field in dataclasses.fields(FrameScore) if field.name != "still"]


def write_map(
    folder: Path,
    version: MapVersion,
    frames: DeliveredFrames,
    names: Sequence[str],
    keyframes: KeyframeStore,
    near: float,
    undistorter: Undistorter | None = None,
) -> None:
    """Write `splats.ply`, `trajectory.txt`, `frames.json` and `colmap/`.

    `exposure.json` is added where exposures are estimated, and `masks/` where keyframes are masked.

    Args:
        folder: An existing folder.
        version: The map.
        frames: Metadata and points of all frames.
        names: Image names for the COLMAP model.
        keyframes: The map's keyframes.
        near: Depth below which nothing is drawn [scene units].
        undistorter: Undistorter of the first frame's image, None if it is not known.
    """
    selected = {keyframe.index for keyframe in keyframes.selected}
    origin = frames.from_origin
    poses = [shifted_poses(T, origin) for T in version.trajectory]
    write_splats(folder / "splats.ply", version.gaussians, origin)
    write_trajectory(folder / "trajectory.txt", frames.timestamp, poses)
    write_colmap(folder / "colmap", names, frames.camera, poses, frames.points, origin)
    lines = [line for line, index in enumerate(frames.index) if index in selected]
    held_out = [line for line, held in enumerate(frames.held_out) if held]
    write_frames(folder / "frames.json", near, keyframes.scene_depth, lines, held_out, undistorter, origin)
    if any(exposure is not None for exposure in version.exposures):
        estimated = {keyframe.index for keyframe in keyframes if keyframe.exposure is not None}
        write_exposures(folder / "exposure.json", frames.index, frames.timestamp, version.exposures, estimated)
    places = {index: place for place, index in enumerate(frames.index)}
    masks = {places[view.index]: view.transient for view in keyframes if view.transient is not None}
    if masks:
        write_masks(folder / "masks", masks)


# ---- frames.json: facts that later commands need and no other file contains --------------------------------------


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
    with reading(path):
        data = read_json(path, "of a finished run")
        stored = None
        if (given := data.get("stored_camera")) is not None:
            lens: dict[str, Any] = {
                name: tuple(v) if isinstance(v, list) else v for name, v in given["distortion"].items()
            }
            camera = PinholeCamera(**{name: value for name, value in given.items() if name != "distortion"})
            stored = Intrinsics(*require_plausible(camera, Distortion(**lens), f"{path}: stored_camera"))
        origin = np.array(data.get("origin", NO_ORIGIN), dtype=np.float64).reshape(3)
        record = FramesRecord(data["near"], data["scene_depth"], data["keyframes"], data["held_out"], stored, origin)
        if not (0 < record.near < math.inf and 0 < record.scene_depth < math.inf and np.isfinite(origin).all()):
            raise ValueError("near, scene_depth or origin is no length")
        if not record.keyframes or not set(record.keyframes + record.held_out) <= set(range(count)):
            raise ValueError(f"keyframes and held_out must be among the {count} frames that trajectory.txt has")
        return record


# ---- exposure.json: the estimated exposure of every frame --------------------------------------------------------


def write_exposures(
    path: Path,
    indices: Sequence[int],
    timestamps: Sequence[float],
    exposures: Sequence[NDArray[np.float64] | None],
    keyframes: set[int],
) -> None:
    """Write the exposure (A, b) of every frame, which maps the map's `colour` to A colour + b.

    Args:
        path: The file.
        indices: Indices of the frames.
        timestamps: Their time stamps [s].
        exposures: (3, 4) matrix (A, b) of each frame. None is written as the identity.
        keyframes: Indices of the frames whose exposure was estimated. The others are interpolated.
    """
    frames = [
        {
            "index": index,
            "timestamp": timestamp,
            "keyframe": index in keyframes,
            "matrix": np.round(IDENTITY if exposure is None else exposure, 6).tolist(),
        }
        for index, timestamp, exposure in zip(indices, timestamps, exposures, strict=True)
    ]
    lines = ",\n".join("  " + json.dumps(frame) for frame in frames)
    replace_text(path, f'{{"frames": [\n{lines}\n]}}\n')


def read_exposures(path: Path) -> dict[int, NDArray[np.float64]]:
    """Read exposures (A, b) (3, 4) by frame index. The result is empty if the file does not exist.

    Raises:
        InputError: If the file is damaged.
    """
    if not path.is_file():
        return {}
    with reading(path):
        frames = read_json(path, "of a finished run")["frames"]
        found = {int(frame["index"]): np.array(frame["matrix"], dtype=np.float64).reshape(3, 4) for frame in frames}
        if not all((np.abs(matrix) <= LARGEST).all() for matrix in found.values()):
            raise ValueError("NaN or infinite numbers")
        return found


# ---- masks/: the parts of keyframes that the map does not follow, as they move or have changed since -------------


def write_masks(folder: Path, masks: Mapping[int, NDArray[np.uint8]]) -> None:
    """Write the masks of keyframes, as grey PNG images.

    Args:
        folder: The folder, which is made.
        masks: Weights (h, w) by the position of the frame, see `Keyframe.transient`.
    """
    folder.mkdir()
    for place, mask in masks.items():
        (folder / f"{place:06d}.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())


def read_masks(folder: Path) -> dict[int, NDArray[np.uint8]]:
    """Read the masks (h, w) by the position of the frame. The result is empty if the folder does not exist.

    Raises:
        InputError: If a file is damaged.
    """
    masks = {}
    for path in sorted(folder.glob("*.png")):
        with reading(path):
            mask = decoded_as(read_bytes(path), cv2.IMREAD_UNCHANGED)
            if mask is None or mask.ndim != 2 or mask.dtype != np.uint8:
                raise ValueError("it must be a grey image")
            masks[int(path.stem)] = mask
    return masks


# ---- scores.csv: one line per frame and version of the map -------------------------------------------------------


def write_scores(path: str | os.PathLike[str], scores: Iterable[FrameScore]) -> None:
    """Write the scores with a header line.

    The columns are index, name, held_out (0 or 1), stage, psnr [dB], ssim, lpips and detail (both empty if not
    computed). Numbers are written with enough digits to be read back exactly.
    """
    with replacing(path, "w") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for score in scores:
            values = (getattr(score, name) for name in COLUMNS)
            writer.writerow(int(v) if isinstance(v, bool) else v for v in values)


def read_scores(path: str | os.PathLike[str]) -> list[FrameScore]:
    """Read a file that `write_scores` wrote.

    Raises:
        InputError: If the file is not valid. The message names the line.
    """
    scores: list[FrameScore] = []
    with reading(path):
        rows = csv.reader(input_lines(Path(path)))
        if next(rows, None) != COLUMNS:
            raise InputError(f"{path}:1: the columns must be {','.join(COLUMNS)}")
        try:
            for index, name, held_out, stage, psnr, ssim, *others in rows:
                lpips, detail = (float(value) if value else None for value in others)
                held = {"0": False, "1": True}[held_out]
                scores.append(FrameScore(int(index), name, held, stage, float(psnr), float(ssim), lpips, detail))
        except (ValueError, KeyError):
            raise InputError(f"{path}:{len(scores) + 2}: not a line of scores") from None
    return scores
