"""Maps a recording with faulty frames and the intact one, to measure the loss of quality."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import exp_se3
from modp_ti.outputs.formats.trajectory import read_trajectory, write_trajectory
from tests.fault_injection.runs import finished, metrics
from tests.room import Room, RoomRecording, pinhole, walk

__all__ = ["FAULTS", "Stream", "map_both", "stream_table", "write_recording"]

HOLDOUT = 8
FPS = 10.0
WALK = 2.4  # length of the camera's path [m]
FAULTS = ("black image", "cut-off image", "repeated image", "pose that jumps", "pose of NaN", "clock that jumps")
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


@dataclass(frozen=True)
class Stream:
    """Result of both runs.

    Attributes:
        frames: Number of frames of the recording.
        faulty: Indices of the faulty frames by fault.
        clean: metrics.json of the run on the intact recording.
        disturbed: metrics.json of the run on the corrupted one.
    """

    frames: int
    faulty: dict[str, list[int]]
    clean: dict
    disturbed: dict

    @property
    def loss(self) -> float:
        """Held-out PSNR that the faults cost [dB]."""
        return held_out(self.clean) - held_out(self.disturbed)


def held_out(figures: dict) -> float:
    """Return the PSNR of the held-out frames [dB]."""
    return figures["refined"]["held_out"]["psnr"]


def write_recording(folder: Path, frames: int, scale: float, steps: int, refine: int) -> None:
    """Write a walk through the test room as an image folder with a TUM trajectory and the tracked points."""
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


def disturb(folder: Path, share: float, seed: int) -> dict[str, list[int]]:
    """Corrupt a fraction `share` of a recording's frames, none of them held out, and return their indices by fault."""
    chance = random.Random(seed)
    images = sorted((folder / "images").iterdir())
    times, poses = read_trajectory(folder / "poses.txt")
    # The first frames stay intact, since a corrupted start is a different case.
    places = [i for i in range(HOLDOUT, len(images)) if i % HOLDOUT]
    chosen = sorted(chance.sample(places, round(share * len(images))))
    kinds = [FAULTS[i % len(FAULTS)] for i in range(len(chosen))]
    chance.shuffle(kinds)
    for i, kind in zip(chosen, kinds, strict=True):
        _spoil(kind, i, images, times, poses, chance)
    write_trajectory(folder / "poses.txt", times, poses)
    faulty = {kind: [i for i, of in zip(chosen, kinds, strict=True) if of == kind] for kind in FAULTS}
    lines = (folder / "poses.txt").read_text(encoding="utf-8").splitlines()
    for i in faulty["pose of NaN"]:
        lines[i + 1] = " ".join([lines[i + 1].split()[0], *["nan"] * 7])  # + 1 for the header line
    (folder / "poses.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return faulty


def _spoil(
    kind: str,
    i: int,
    images: list[Path],
    times: NDArray[np.float64],
    poses: NDArray[np.float64],
    chance: random.Random,
) -> None:
    if kind == "black image":
        cv2.imwrite(str(images[i]), np.zeros_like(cv2.imread(str(images[i]))))
    elif kind == "cut-off image":
        data = images[i].read_bytes()
        images[i].write_bytes(data[: len(data) // 2])
    elif kind == "repeated image":
        images[i].write_bytes(images[i - 1].read_bytes())
    elif kind == "pose that jumps":
        away = [chance.choice((-1.0, 1.0)) * value for value in (0.8, 0.3, 0.6, 0.3, 0.6, 0.2)]
        poses[i] = exp_se3(away) @ poses[i]
    elif kind == "clock that jumps":
        times[i] += chance.choice((-2.0, 1000.0))


def map_both(
    folder: Path,
    seed: int,
    say: Callable[[str], None],
    frames: int = 80,
    scale: float = 0.5,
    steps: int = 8,
    refine: int = 100,
) -> Stream:
    """Map the intact recording, and one with a tenth of its frames corrupted."""
    shutil.rmtree(folder, ignore_errors=True)
    clean, corrupted = folder / "clean", folder / "corrupted"
    write_recording(clean, frames, scale, steps, refine)
    shutil.copytree(clean, corrupted)
    faulty = disturb(corrupted, 0.1, seed)
    say(f"{frames} frames, {sum(map(len, faulty.values()))} of them corrupted")
    for run in (clean, corrupted):
        ended = finished([str(run / "scene.yaml")], run / "out")
        say(f"{run.name}: {held_out(metrics(run / 'out')):.2f} dB on held-out frames after {ended.seconds:.0f} s")
        for line in ended.said.splitlines():
            if "left out" in line or "did not touch" in line or "no pose" in line:
                say("  " + line)
    return Stream(frames, faulty, metrics(clean / "out"), metrics(corrupted / "out"))


def stream_table(result: Stream) -> str:
    """Return the result as a Markdown table."""
    corrupted = ", ".join(f"{len(places)} {kind}" for kind, places in result.faulty.items())
    left_out = ", ".join(f"{count} {why}" for why, count in result.disturbed["frames_left_out"].items())
    return "\n".join(
        [
            "| a recording with faulty frames | in order | corrupted |",
            "|---|---|---|",
            f"| frames | {result.frames} | {sum(map(len, result.faulty.values()))} corrupted: {corrupted} |",
            f"| frames mapped | {result.clean['frames']} | {result.disturbed['frames']} |",
            f"| left out by the run | | {left_out} |",
            f"| held-out PSNR [dB] | {held_out(result.clean):.2f} | {held_out(result.disturbed):.2f} |",
            f"| lost [dB] | | {result.loss:+.2f} |",
        ]
    )
