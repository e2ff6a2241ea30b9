"""After a warm-up nothing is left to compile; bad input gets one line and exit code 2."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from unittest.mock import MagicMock

import numpy as np
import pytest
from typer.testing import CliRunner

from fields.runtime.engine import engine
from modp_ti.commands import app as cli
from modp_ti.engine import mapper, stages
from tests.patience import PATIENCE

SCENE = """
source: {path: images}
tracker: {kind: colmap}
output: out
device: cpu
mapping: {optimise: {steps: 1}, densify: {pixels: 200, warm_up: 2}}
refine: {steps: 1}
export: {report: false}
"""


@pytest.mark.parametrize(
    ("call", "named"),
    [("", "--size"), ("--size 640x0", "640x0"), ("--size 640x480 --set seed=1", "--set"), ("gone.yaml", "gone.yaml")],
)
def test_bad_input_gets_one_line_and_exit_code_two(call: str, named: str) -> None:
    result = CliRunner().invoke(cli.app, ["warmup", *call.split()])
    assert (result.exit_code, result.stdout, result.stderr.count("\n")) == (2, "", 1)
    assert result.stderr.startswith("error: ") and named in result.stderr


@pytest.mark.parametrize(
    ("arguments", "size"),
    [
        (["live.yaml"], (stages.EXPECTED.width, stages.EXPECTED.height)),
        (["live.yaml", "--size", "320x240"], (640, 640)),
        (["live.yaml", "--size", "960x540"], (960, 540)),
        (["--size", "320x240"], (320, 240)),
    ],
)
def test_a_realtime_run_is_compiled_for_the_images_that_it_expects(arguments, size, tmp_path, monkeypatch) -> None:
    (tmp_path / "live.yaml").write_text("{tracker: {kind: socket}, output: out, device: cpu}")
    monkeypatch.chdir(tmp_path)
    cameras = []
    monkeypatch.setattr(mapper, "build_mapper", lambda _, camera: cameras.append(camera) or MagicMock())
    result = CliRunner().invoke(cli.app, ["warmup", *arguments])
    assert result.exit_code == 0, result.stderr
    assert [(camera.width, camera.height) for camera in cameras] == [size]


@pytest.mark.slow
def test_a_run_after_the_warm_up_compiles_nothing(plane_scene, tmp_path) -> None:
    plane_scene.write_colmap(np.random.default_rng(0).uniform(-1, 1, (60, 3)) * [1.8, 1.8, 0])
    scene = plane_scene.folder.parent / "scene.yaml"
    scene.write_text(SCENE)
    cache = tmp_path / "cache"
    environment = os.environ | {
        engine().variable("offline_cache_file_path"): str(cache),
        "TORCH_HOME": str(tmp_path / "no-torch"),
    }

    def kernels_after(*arguments: str) -> tuple[set[str], str]:
        command = [sys.executable, "-m", *arguments]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False)
        assert done.returncode == 0, done.stderr
        return {file.name for file in cache.rglob("*") if file.suffix == engine().cache_suffix}, done.stdout

    compiled, said = kernels_after("modp_ti.commands.app", "warmup", str(scene))
    assert len(compiled) > 30
    assert re.search(r"^320x240 on cpu: [0-9.]+ s$", said, re.MULTILINE)
    assert kernels_after("modp_ti.commands.app", "run", str(scene))[0] == compiled
