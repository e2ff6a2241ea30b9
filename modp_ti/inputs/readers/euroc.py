"""Kind `euroc`: sequences in EuRoC's layout, of which the left camera and the true poses of the body are used."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from fields.geometry.se3 import inverse_se3
from modp_ti.files import reading
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import SETTING, FileTree
from modp_ti.files.trajectory import poses_of_quaternions
from modp_ti.files.yaml_text import parse_yaml
from modp_ti.inputs.capture import (
    Capture,
    CapturedFrame,
    checked_numbers,
    opencv_pose,
    plausible_camera,
    read_lines,
    read_numbers,
)
from modp_ti.inputs.capture_reader import CaptureSettings
from modp_ti.inputs.sources.distortion import EQUIDISTANT, PLUMB_BOB, Distortion, lens_of_model
from modp_ti.inputs.timed_poses import associate

LISTING, SENSOR = "cam0/data.csv", "cam0/sensor.yaml"
# The true poses of the body, or those of markers on it: EuRoC's, TUM-VI's and EuRoC's raw ones.
TRUTHS = "state_groundtruth_estimate0", "mocap0", "vicon0"
MAX_DIFFERENCE = 0.01  # [s] between an image and its pose; the truth has 200 poses a second
NANOSECOND = 1e-9


class EurocSettings(CaptureSettings):
    """The true poses of a sequence in EuRoC's layout."""

    holds: ClassVar[str] = "mav0/cam0/data.csv and mav0/cam0/sensor.yaml"

    kind: Literal["euroc"] = "euroc"

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return _top(tree) is not None

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the images of the left camera with the true poses. Images without one, as before the truth begins, stay.

        T_world_camera is T_world_body of the truth times T_BS of the camera. A sequence without the truth has no poses.
        """
        top = _top(tree) or ""
        sensor, where = _sensor(tree, top + SENSOR), str(tree.path / (top + SENSOR))
        width, height = checked_numbers(sensor.get("resolution"), 2, f"{where}: `resolution`")
        fx, fy, cx, cy = checked_numbers(sensor.get("intrinsics"), 4, f"{where}: `intrinsics`")
        lens = _lens(sensor, where)
        # The calibration has pixel centres at whole numbers.
        camera = plausible_camera(fx, fy, cx + 0.5, cy + 0.5, (width, height), where, lens)
        T_camera_body = opencv_pose(_mount(sensor, where), f"{where}: `T_BS`")

        listed = {}
        for n, line in read_lines(tree, top + LISTING):
            time, _, name = (part.strip() for part in line.partition(","))
            if not (time.isascii() and time.isdecimal() and len(time) <= 20 and name):
                raise InputError(f"{tree.path / (top + LISTING)}:{n}: must be a time in nanoseconds and a file name")
            listed[f"{top}cam0/data/{name}"] = int(time) * NANOSECOND
        there = {name: time for name, time in listed.items() if tree.has(name)}
        if not there:
            raise InputError(f"{tree.path / (top + LISTING)}: none of its {len(listed)} images is there")
        folder = next((name for name in TRUTHS if tree.has(f"{top}{name}/data.csv")), TRUTHS[0])
        origin, markers = f"{top}{folder}/data.csv", f"{top}{folder}/sensor.yaml"
        pose_of, T_world_body = {}, np.zeros((0, 4, 4))
        if tree.has(origin):
            rows = read_numbers(tree, origin, 8, "time, px, py, pz, qw, qx, qy, qz, ...")
            T_world_body = poses_of_quaternions(
                rows[:, 1:4], rows[:, [5, 6, 7, 4]], lambda n: f"{tree.path / origin}: pose {n}"
            )
            if folder != TRUTHS[0] and tree.has(markers):
                T_world_body = T_world_body @ opencv_pose(_mount(_sensor(tree, markers), markers), f"{markers}: `T_BS`")
            pose_of = dict(associate(list(there.values()), rows[:, 0] * NANOSECOND, MAX_DIFFERENCE).tolist())
        frames = []
        for n, (name, time) in enumerate(there.items()):
            T = T_camera_body @ inverse_se3(T_world_body[pose_of[n]]) if n in pose_of else None
            frames.append(CapturedFrame(name, time, camera, T, lens))
        notes = []
        if len(there) < len(listed):
            notes.append(f"{len(listed) - len(there)} of the {len(listed)} images of {top}{LISTING} are not there")
        return Capture(tree, origin, frames, notes)


def _top(tree: FileTree) -> str | None:
    return next((top for top in ("mav0/", "") if tree.has(top + SENSOR) and tree.has(top + LISTING)), None)


def _sensor(tree: FileTree, name: str) -> dict[str, Any]:
    """Read the camera's YAML. Some have OpenCV's first line and tags, which are not those of YAML."""
    with reading(tree.path / name, SETTING):
        text = tree.read_text(name)
    plain = "\n".join("" if line.startswith("%YAML") else line for line in text.splitlines())
    data = parse_yaml(plain.replace("!!opencv-matrix", ""), str(tree.path / name), {})
    if not isinstance(data, dict):
        raise InputError(f"{tree.path / name}: is no YAML of a camera; copy it again")
    return data


def _mount(sensor: dict[str, Any], where: str) -> list[float]:
    """The numbers of `T_BS`, sensor to body, row by row."""
    mount = sensor.get("T_BS")
    return checked_numbers(mount.get("data") if isinstance(mount, dict) else None, 16, f"{where}: `T_BS`")


def _lens(sensor: dict[str, Any], where: str) -> Distortion:
    model, values = str(sensor.get("distortion_model", "none")).lower(), sensor.get("distortion_coefficients")
    if model in ("none", "null"):
        return Distortion()
    if model not in (*PLUMB_BOB, *EQUIDISTANT):
        raise InputError(f"{where}: the lens model {model[:40]!r} is not supported (radial-tangential, equidistant)")
    count = len(values) if isinstance(values, list) and len(values) in (5, 8) else 4
    return lens_of_model(model, checked_numbers(values, count, f"{where}: `distortion_coefficients`"), where)
