"""Long runs: killed at random moments, through a recording with faulty frames, and of tens of thousands of frames."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest

from fields.geometry.se3 import exp_se3
from modp_ti.engine.mapper import Mapper
from modp_ti.outputs.formats.trajectory import read_trajectory, write_trajectory
from pipelines.settings import MappingSettings, OptimiseSettings
from tests.fault_injection.recordings import HOLDOUT, write_recording
from tests.room import Room, RoomRecording, pinhole, walk

DEMO = Path(__file__).resolve().parents[2] / "demo" / "room.mp4"
KILLS, SOAK = 50, 20_000
# Part of the demo, so small that starting the process takes the most time. Exposure estimation is enabled, and `klt`
# corrects its poses, so that the snapshots contain all kinds of state.
KILLED = f"""\
source:
  path: {json.dumps(str(DEMO))}
  intrinsics: {{fx: 512, cx: 320, cy: 240}}
  scale: 0.25
  holdout: 4
  step: 4
  stop: 104
tracker: {{kind: klt}}
output:  reference
device:  cpu
mapping: {{optimise: {{steps: 4}}, exposure: {{enabled: true}}}}
refine:  {{steps: 40}}
export:  {{report: false}}
snapshot_every: 2
"""


def run(*arguments: object, kill_after: float | None = None) -> float:
    """Run `modp-ti run`, kill it after so many seconds, and return how long it took [s]; 0 if it was killed."""
    started = time.monotonic()
    process = subprocess.Popen([sys.executable, "-m", "modp_ti.run", *map(str, arguments)], stderr=subprocess.PIPE)
    try:
        _, said = process.communicate(timeout=kill_after)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return 0.0
    assert process.returncode == 0, said.decode()
    return time.monotonic() - started


def test_a_run_killed_at_random_moments_ends_with_the_same_bytes(tmp_path: Path) -> None:
    scene, output = tmp_path / "scene.yaml", tmp_path / "killed"
    scene.write_text(KILLED, encoding="utf-8")
    seconds = run(scene)
    chance = random.Random(0)
    kills = 0
    while kills < KILLS:
        resumes = (output / "snapshot.npz").is_file()
        arguments = ("--resume", output) if resumes else (scene, "--set", f"output={json.dumps(str(output))}")
        if not run(*arguments, kill_after=chance.uniform(0.0, 1.2 * seconds)):
            kills += 1
            continue
        for name in ("splats.ply", "trajectory.txt"):
            assert (output / name).read_bytes() == (tmp_path / "reference" / name).read_bytes()
        left = [*tmp_path.glob("**/*.partial"), *tmp_path.glob("**/.modp-ti-*"), *output.glob("snapshot.npz")]
        assert not left, left
        shutil.rmtree(output)


def spoil(folder: Path, chance: random.Random) -> None:
    """Corrupt a tenth of a recording's frames, none of the first or held out, in six ways."""
    images = sorted((folder / "images").iterdir())
    times, poses = read_trajectory(folder / "poses.txt")
    places = [i for i in range(HOLDOUT, len(images)) if i % HOLDOUT]
    lost = []
    for number, i in enumerate(sorted(chance.sample(places, round(0.1 * len(images))))):
        match number % 6:
            case 0:
                cv2.imwrite(str(images[i]), np.zeros_like(cv2.imread(str(images[i]))))
            case 1:
                data = images[i].read_bytes()
                images[i].write_bytes(data[: len(data) // 2])
            case 2:
                images[i].write_bytes(images[i - 1].read_bytes())
            case 3:
                poses[i] = exp_se3([chance.choice((-1.0, 1.0)) * v for v in (0.8, 0.3, 0.6, 0.3, 0.6, 0.2)]) @ poses[i]
            case 4:
                times[i] += chance.choice((-2.0, 1000.0))
            case 5:
                lost.append(i + 1)  # after the header
    write_trajectory(folder / "poses.txt", times, poses)
    lines = (folder / "poses.txt").read_text(encoding="utf-8").splitlines()
    for i in lost:
        lines[i] = " ".join([lines[i].split()[0], *["nan"] * 7])
    (folder / "poses.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def test_a_tenth_of_faulty_frames_costs_less_than_a_decibel(tmp_path: Path) -> None:
    clean, spoilt = tmp_path / "clean", tmp_path / "spoilt"
    write_recording(clean, frames=80, scale=0.5, steps=8, refine=100)
    shutil.copytree(clean, spoilt)
    spoil(spoilt, random.Random(0))
    scores = []
    for folder in (clean, spoilt):
        run(folder / "scene.yaml")
        found = json.loads((folder / "out" / "metrics.json").read_text(encoding="utf-8"))
        scores.append(found["refined"]["held_out"]["psnr"])
    assert scores[1] > scores[0] - 1.0


@pytest.mark.parametrize("memory", [None, 0.02])
def test_the_memory_grows_with_the_keyframes_alone(memory: float | None) -> None:
    recorded = RoomRecording(Room(), pinhole(80, 60), walk(56)).frames()
    there_and_back = [*recorded, *recorded[-2:0:-1]]
    mapper = Mapper(80, 60, MappingSettings(optimise=OptimiseSettings(steps=1), memory=memory))
    rest = []
    for index in range(SOAK):
        frame = there_and_back[index % len(there_and_back)]
        mapper.add(replace(frame, index=index, timestamp=index / 10))
        if (index + 1) % (SOAK // 10) == 0:
            kept = mapper.pipeline.keyframes.nbytes + mapper.frames.points.nbytes
            rest.append(psutil.Process(os.getpid()).memory_info().rss - kept)
    assert rest[-1] < 1.05 * rest[0]
