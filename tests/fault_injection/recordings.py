"""A recording of the test room as files: an image folder with a TUM trajectory and the tracked points."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from modp_ti.outputs.formats.trajectory import write_trajectory
from tests.room import Room, RoomRecording, pinhole, walk

HOLDOUT = 8
FPS = 10.0
WALK = 2.4  # length of the camera's path [m]
SCENE = """\
source:
  path: images
  fps: {fps}
  holdout: {holdout}
  intrinsics: {{fx: {focal}, cx: {cx}, cy: {cy}}}
tracker: {{kind: tum, path: poses.txt, points: points.txt}}
output: out
device: cpu
mapping: {{optimise: {{steps: {steps}}}}}
refine: {{steps: {refine}}}
export: {{report: false}}
"""


def write_recording(folder: Path, frames: int, scale: float, steps: int, refine: int) -> None:
    """Write a walk through the test room, and the scene that maps it.

    Args:
        folder: Folder of the scene.
        frames: Number of frames.
        scale: Size of the images as a share of 320x240.
        steps: Steps of the optimisation for each keyframe.
        refine: Steps of the refinement.
    """
    camera = pinhole(round(320 * scale), round(240 * scale))
    recording = RoomRecording(Room(), camera, walk(frames, WALK / frames))
    (folder / "images").mkdir(parents=True)
    poses, points = [], {}
    for frame, image in zip(recording.frames(), recording.images, strict=True):
        cv2.imwrite(str(folder / "images" / f"{frame.index:06d}.png"), image[..., ::-1])
        poses.append(frame.T_camera_world)
        points |= dict(zip(frame.points.ids.tolist(), frame.points.xyz.tolist(), strict=True))
    write_trajectory(folder / "poses.txt", np.arange(frames) / FPS, poses)
    text = "\n".join(" ".join(map(repr, xyz)) for xyz in points.values())
    (folder / "points.txt").write_text(text + "\n", encoding="utf-8")
    scene = SCENE.format(
        fps=FPS, holdout=HOLDOUT, focal=camera.fx, cx=camera.cx, cy=camera.cy, steps=steps, refine=refine
    )
    (folder / "scene.yaml").write_text(scene, encoding="utf-8")
