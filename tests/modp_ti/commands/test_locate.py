"""`modp-ti locate`: what it prints of pictures of the test room. Each call starts Taichi again."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from fields.geometry.se3 import exp_se3
from modp_ti.commands.app import app
from modp_ti.outputs.formats.trajectory import read_trajectory
from tests.modp_ti.outputs.locating.painted_room import CAMERA, another_room, photograph, write_run
from tests.room import Room, walk

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def out(made_once: Callable[[str, Callable[[Path], None]], Path], room: Room) -> Path:
    return (
        made_once("a painted room without distortion", lambda folder: (write_run(room, folder / "out"), None)[1])
        / "out"
    )


def test_the_command_says_which_pictures_it_has_located(out: Path, room: Room, tmp_path: Path) -> None:
    T = exp_se3([0.1, -0.05, 0.1, 0.05, -0.04, 0.02]) @ walk(13, step=0.1)[3]
    cv2.imwrite(str(tmp_path / "here.png"), photograph(room, CAMERA, T)[..., ::-1])
    cv2.imwrite(str(tmp_path / "elsewhere.png"), photograph(another_room(), CAMERA, T)[..., ::-1])
    names = [str(tmp_path / name) for name in ("elsewhere.png", "here.png")]

    alone = CliRunner().invoke(app, ["locate", str(out), names[1], "--device", "cpu"])
    assert alone.exit_code == 0, alone.output
    (tmp_path / "found.txt").write_text(alone.stdout)
    times, poses = read_trajectory(tmp_path / "found.txt")
    assert times.tolist() == [0.0]

    both = CliRunner().invoke(app, ["locate", str(out), *names, "--device", "cpu", "--json"])
    assert both.exit_code == 1, both.output
    missed, found = json.loads(both.stdout)["pictures"]
    assert not missed["located"] and missed["reason"] and "T_camera_world" not in missed
    assert found["located"] and found["inliers"] >= 20 and np.shape(found["covariance"]) == (6, 6)
    np.testing.assert_allclose(poses[0], found["T_camera_world"], atol=1e-9)


def test_a_picture_that_cannot_be_read_is_wrong_input(out: Path, tmp_path: Path) -> None:
    (tmp_path / "text.png").write_text("no picture")
    result = CliRunner().invoke(app, ["locate", str(out), str(tmp_path / "text.png"), "--device", "cpu"])
    assert result.exit_code == 2 and "text.png" in result.stderr
    for missing in (tmp_path / "nope.jpg", tmp_path):  # said before the map is rendered, which takes seconds
        said = CliRunner().invoke(app, ["locate", str(out), str(tmp_path / "text.png"), str(missing)])
        assert said.exit_code == 2 and said.stderr.startswith(f"error: {missing}: ") and said.stderr.count("\n") == 1
    result = CliRunner().invoke(app, ["locate", str(out), str(tmp_path / "text.png"), "--camera", "fx=5,focus=3"])
    assert result.exit_code == 2 and "focus" in result.stderr
