"""Sequences of EuRoC MAV and data sets in its layout: the left camera, and the true poses of the body."""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml

from fields.geometry.se3 import inverse_se3
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.files.reading import readable
from modp_ti.files.trajectory import poses_of_quaternions
from modp_ti.inputs.association import associate
from modp_ti.inputs.captures.capture import Capture, CapturedFrame, checked_numbers, opencv_pose, plausible_camera
from modp_ti.inputs.captures.tables import read_lines, read_numbers
from modp_ti.inputs.sources.distortion import Distortion

__all__ = ["is_euroc", "read_euroc"]

LISTING, SENSOR, TRUTH = "cam0/data.csv", "cam0/sensor.yaml", "state_groundtruth_estimate0/data.csv"
MAX_DIFFERENCE = 0.01  # [s] between an image and its pose; the truth has 200 poses a second
NANOSECOND = 1e-9
# Bounds on the file of the camera, which has some 40 lines: characters, and lists that could be nested.
LONGEST_SENSOR, MOST_LISTS = 1 << 14, 64


def is_euroc(tree: FileTree) -> bool:
    """Whether the files are a sequence in EuRoC's layout."""
    return _top(tree) is not None


def read_euroc(tree: FileTree) -> Capture:
    """Read the images of the left camera with the true poses. Images without one, as before the truth begins, stay.

    T_world_camera is T_world_body of the truth times T_BS of the camera.

    Raises:
        InputError: If a file is missing or malformed.
    """
    top = _top(tree) or ""
    sensor = _sensor(tree, top + SENSOR)
    where = str(tree.path / (top + SENSOR))
    size = checked_numbers(sensor.get("resolution"), 2, f"{where}: `resolution`")
    fx, fy, cx, cy = checked_numbers(sensor.get("intrinsics"), 4, f"{where}: `intrinsics`")
    lens = _lens(sensor, where)
    # The calibration has pixel centres at whole numbers.
    camera = plausible_camera(fx, fy, cx + 0.5, cy + 0.5, (size[0], size[1]), where, lens)
    mount = sensor.get("T_BS")
    mount = mount.get("data") if isinstance(mount, dict) else None
    T_camera_body = opencv_pose(checked_numbers(mount, 16, f"{where}: `T_BS`"), f"{where}: `T_BS`")

    listed = [_listed(line, f"{tree.path / (top + LISTING)}:{n}") for n, line in read_lines(tree, top + LISTING)]
    there = [(time, f"{top}cam0/data/{name}") for time, name in listed if tree.has(f"{top}cam0/data/{name}")]
    if not there:
        raise InputError(f"{tree.path / (top + LISTING)}: none of its {len(listed)} images is there")
    rows, lines = read_numbers(tree, top + TRUTH, 8, "time, px, py, pz, qw, qx, qy, qz, ...")
    of_line = lambda n: f"{tree.path / (top + TRUTH)}:{lines[n]}"  # noqa: E731
    T_world_body = poses_of_quaternions(rows[:, 1:4], rows[:, [5, 6, 7, 4]], of_line)
    times = np.array([time for time, _ in there])
    pose_of = dict(associate(times, rows[:, 0] * NANOSECOND, MAX_DIFFERENCE).tolist())
    frames = []
    for n, (time, name) in enumerate(there):
        T = T_camera_body @ inverse_se3(T_world_body[pose_of[n]]) if n in pose_of else None
        frames.append(CapturedFrame(name, time, camera, T, lens))
    notes = [f"{tree.path}: is a sequence in EuRoC's layout, of which the left camera is used"]
    if len(there) < len(listed):
        notes.append(f"{len(listed) - len(there)} of the {len(listed)} images that {top}{LISTING} lists are not there")
    return Capture("euroc", tree, top + TRUTH, frames, notes)


def _top(tree: FileTree) -> str | None:
    return next((top for top in ("mav0/", "") if tree.has(top + SENSOR) and tree.has(top + LISTING)), None)


def _sensor(tree: FileTree, name: str) -> dict[str, Any]:
    """Read the camera's YAML. Some have OpenCV's first line and tags, which are not those of YAML."""
    with readable(tree.path / name, " (source.path)"):
        text = tree.read_text(name)
    lines = [line for line in text.splitlines() if not line.startswith("%YAML")]
    try:
        large = len(text) > LONGEST_SENSOR or text.count("[") + text.count("{") > MOST_LISTS
        data = None if large else yaml.safe_load("\n".join(lines).replace("!!opencv-matrix", ""))
    except (yaml.YAMLError, ValueError, RecursionError):
        data = None
    if not isinstance(data, dict):
        raise InputError(f"{tree.path / name}: is no YAML of a camera; copy it again")
    return data


def _lens(sensor: dict[str, Any], where: str) -> Distortion:
    model = str(sensor.get("distortion_model", "none")).lower()
    values = sensor.get("distortion_coefficients")
    if model in ("none", "null"):
        return Distortion()
    k1, k2, third, fourth = checked_numbers(values, 4, f"{where}: `distortion_coefficients`")
    if model in ("radial-tangential", "radtan", "plumb_bob"):
        return Distortion((k1, k2), tangential=(third, fourth))
    if model in ("equidistant", "equi", "fisheye"):
        return Distortion((k1, k2, third, fourth), fisheye=True)
    raise InputError(f"{where}: the lens model {model[:40]!r} is not supported (radial-tangential, equidistant)")


def _listed(line: str, where: str) -> tuple[float, str]:
    """Time [s] and file name of a line of the images' table."""
    first, _, name = (part.strip() for part in line.partition(","))
    if not (first.isascii() and first.isdecimal() and len(first) <= 20 and name):
        raise InputError(f"{where}: must be a time in nanoseconds and a file name, not {line[:60]!r}")
    return int(first) * NANOSECOND, name
