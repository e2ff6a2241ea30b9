"""The same input gives the same map bit for bit, on any number of threads."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PATIENCE

pytestmark = pytest.mark.slow
PROJECT = Path(__file__).resolve().parents[2]
# The wall of test_mapping.py: every stage, with a correction, pruning, pose refinement and post refinement.
CODE = """
import hashlib, sys
import numpy as np
from fields.runtime.backend import initialise
from fields.frames.pose_correction import PoseCorrection
from fields.geometry.se3 import exp_se3
from pipelines.online import OnlineMapper
from pipelines.refinement import refine
from pipelines.settings import RefineSettings
from tests.pipelines.test_online import SETTINGS, frame

initialise("cpu", threads=int(sys.argv[1]))
mapper = OnlineMapper(SETTINGS, 64, 48, seed=5)
for i in range(5):
    mapper.process(frame(i))
    if i == 3:
        ends = np.stack([exp_se3([0.2, 0, 0.1, 0, 0.03 * j, 0]) @ frame(j).T_camera_world for j in (0, 3)])
        assert mapper.correct(PoseCorrection(np.array([0, 3]), ends)).moved
mapper.finish()
refine(mapper, RefineSettings(steps=20))
digest = hashlib.sha256()
for value in mapper.gaussians.to_numpy().values():
    digest.update(value.tobytes())
for view in mapper.keyframes:
    digest.update(view.T_camera_world.tobytes())
print(len(mapper.gaussians), digest.hexdigest())
"""


def start(threads: int) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", CODE, str(threads)]
    return subprocess.Popen(command, cwd=PROJECT, stdout=subprocess.PIPE, text=True)


def test_a_map_is_the_same_byte_for_byte_on_one_thread_and_on_three() -> None:
    runs = [start(1), start(3)]
    count, digest = runs[0].communicate(timeout=PATIENCE)[0].split()[-2:]
    assert runs[1].communicate(timeout=PATIENCE)[0].split()[-2:] == [count, digest]
    assert [run.returncode for run in runs] == [0, 0]
    assert int(count) > 300
