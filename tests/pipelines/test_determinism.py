"""The same input gives the same map bit for bit, on any number of threads."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PATIENCE

pytestmark = pytest.mark.slow
PROJECT = Path(__file__).resolve().parents[2]
# Every stage, with a correction, pruning, pose refinement and post refinement.
ONLINE = """
import numpy as np
from fields.frames.pose_correction import PoseCorrection
from fields.geometry.se3 import exp_se3
from pipelines.online import OnlineMapper
from pipelines.refinement import refine
from pipelines.settings import RefineSettings
from tests.pipelines.test_online import SETTINGS, frame

mapper = OnlineMapper(SETTINGS, 64, 48, seed=5)
for i in range(5):
    mapper.process(frame(i))
    if i == 3:
        ends = np.stack([exp_se3([0.2, 0, 0.1, 0, 0.03 * j, 0]) @ frame(j).T_camera_world for j in (0, 3)])
        assert mapper.correct(PoseCorrection(np.array([0, 3]), ends)).moved
mapper.finish()
refine(mapper, RefineSettings(steps=20))
for view in mapper.keyframes:
    digest.update(view.T_camera_world.tobytes())
"""
OFFLINE = """
from tests.pipelines.test_offline import SETTINGS, mapper

mapper = mapper(SETTINGS.model_copy(update={"steps": 200}))
mapper.initialise()
mapper.optimise()
"""
BEFORE = """
import hashlib, sys
from fields.runtime.backend import initialise
digest = hashlib.sha256()
"""
START = """
initialise("cpu", threads=int(sys.argv[1]))
"""
AFTER = """
for value in mapper.gaussians.to_numpy().values():
    digest.update(value.tobytes())
print(len(mapper.gaussians), digest.hexdigest())
"""


def test_maps_are_the_same_byte_for_byte_on_one_thread_and_on_three() -> None:
    command = [sys.executable, "-c", BEFORE + START + ONLINE + AFTER + START + OFFLINE + AFTER]
    runs = [subprocess.Popen([*command, f"{n}"], cwd=PROJECT, stdout=subprocess.PIPE, text=True) for n in (1, 3)]
    printed = [run.communicate(timeout=PATIENCE)[0].split()[-4:] for run in runs]
    assert printed[0] == printed[1] and [run.returncode for run in runs] == [0, 0]
    assert int(printed[0][0]) > 300 and int(printed[0][2]) > 6 * 120
