"""Kind `arkitscenes`: scenes of ARKitScenes, of which the low-resolution images of the wide camera are used."""

from __future__ import annotations

import re
from typing import ClassVar, Literal

import numpy as np

from fields.geometry.se3 import exp_se3, inverse_se3
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.capture import Capture, CapturedFrame, depth_files, opencv_pose, plausible_camera, read_numbers
from modp_ti.inputs.capture_reader import DepthCaptureSettings
from modp_ti.inputs.depth_maps import millimetre_png
from modp_ti.inputs.timed_poses import associate

TRAJECTORY, IMAGES, INTRINSICS = "lowres_wide.traj", "lowres_wide", "lowres_wide_intrinsics"
NAME = re.compile(r"([0-9]{1,12})_([0-9]{1,9}\.[0-9]{1,9})")
CONFIDENT = 2  # of 0, 1 and 2
# Largest differences [s] between the time of an image and those of its intrinsics and its pose.
SAME_TIME, MAX_DIFFERENCE = 0.0015, 0.0055


class ArkitScenesSettings(DepthCaptureSettings):
    """The poses of a scene of ARKitScenes."""

    holds: ClassVar[str] = "lowres_wide, lowres_wide_intrinsics and lowres_wide.traj"

    kind: Literal["arkitscenes"] = "arkitscenes"

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.has(TRAJECTORY) and bool(tree.listed(IMAGES))

    @classmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the images that have intrinsics, with the pose nearest in time.

        A row of the trajectory is a time, an axis times an angle and a translation, world to camera.
        """
        images, cameras = _timed(tree, IMAGES, ".png"), _timed(tree, INTRINSICS, ".pincam")
        if not images or not cameras:
            raise InputError(f"{tree.path}: holds no images in {IMAGES}, or no intrinsics in {INTRINSICS}")
        times, files = np.array(list(images)), list(cameras.values())
        camera_of = dict(associate(times, list(cameras), SAME_TIME).tolist())
        rows = read_numbers(tree, TRAJECTORY, 7, "time, rx, ry, rz, tx, ty, tz")
        pose_of = dict(associate(times, rows[:, 0], MAX_DIFFERENCE).tolist())
        frames = []
        for n, (time, name) in enumerate(images.items()):
            if n not in camera_of:
                continue
            file = files[camera_of[n]]
            width, height, fx, fy, cx, cy = read_numbers(tree, file, 6, "width height fx fy cx cy")[0]
            camera = plausible_camera(fx, fy, cx, cy, (width, height), f"{tree.path / file}")
            T = _pose(rows[pose_of[n]], f"{tree.path / TRAJECTORY}: time {time:.3f}") if n in pose_of else None
            stem = name[len(IMAGES) + 1 :]
            depth, confidence = depth_files(tree, f"lowres_depth/{stem}", f"confidence/{stem}")
            frames.append(CapturedFrame(name, time, camera, T, depth=depth, confidence=confidence))
        notes = []
        if len(frames) < len(images):
            notes.append(f"{len(images) - len(frames)} of its {len(images)} images have no intrinsics: left out")
        return Capture(tree, TRAJECTORY, frames, notes, read_depth=millimetre_png(CONFIDENT))


def _pose(row: np.ndarray, where: str) -> np.ndarray:
    """Return T_camera_world (4, 4) of a row of the trajectory."""
    if np.abs(row[1:4]).max() > 100.0:
        raise InputError(f"{where}: the rotation is none; the file is damaged")
    T = exp_se3([0.0, 0.0, 0.0, *row[1:4]])
    T[:3, 3] = row[4:7]
    return inverse_se3(opencv_pose(T, where))


def _timed(tree: FileTree, folder: str, suffix: str) -> dict[float, str]:
    """The files of a folder by the time [s] in their names, in order."""
    found = {}
    for name in tree.listed(folder):
        match = NAME.fullmatch(name[len(folder) + 1 :].removesuffix(suffix))
        if match and name.endswith(suffix):
            found[float(match[2])] = name
    return dict(sorted(found.items()))
