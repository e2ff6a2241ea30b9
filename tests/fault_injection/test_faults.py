"""Faults on purpose: what is corrupted is what was said, and what the tables say is what came of it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.trackers import open_tracker
from modp_ti.outputs.formats.trajectory import write_trajectory
from tests.fault_injection.kills import KILLS_SCENE, Kills, kills_table
from tests.fault_injection.runs import finished, run_until
from tests.fault_injection.soak import Soak, soak_table
from tests.fault_injection.stream import FAULTS, HOLDOUT, Stream, disturb, stream_table, write_recording
from tests.patience import PATIENCE

FRAMES = 60
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """As `write_recording` leaves it, but of noise."""
    rng = np.random.default_rng(0)
    (tmp_path / "images").mkdir()
    for i in range(FRAMES):
        picture = rng.integers(0, 255, (36, 48, 3), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / "images" / f"{i:06d}.png"), picture)
    write_trajectory(tmp_path / "poses.txt", np.arange(FRAMES) / 10, [np.eye(4)] * FRAMES)
    return tmp_path


def test_a_tenth_of_the_frames_is_spoilt_each_in_its_way_and_no_other(recording: Path) -> None:
    images = sorted((recording / "images").iterdir())
    before = [image.read_bytes() for image in images]
    lines = (recording / "poses.txt").read_text().splitlines()
    faulty = disturb(recording, 0.1, seed=3)
    assert list(faulty) == list(FAULTS) and all(len(places) == 1 for places in faulty.values())
    corrupted = {kind: places[0] for kind, places in faulty.items()}
    assert not any(i % HOLDOUT == 0 or i < HOLDOUT for i in corrupted.values())
    changed = {i for i, image in enumerate(images) if image.read_bytes() != before[i]}
    assert changed == {corrupted[kind] for kind in FAULTS[:3]}
    assert (cv2.imread(str(images[corrupted["black image"]])) == 0).all()
    cut = corrupted["cut-off image"]
    assert images[cut].read_bytes() == before[cut][: len(before[cut]) // 2]
    after = (recording / "poses.txt").read_text().splitlines()
    assert {i for i in range(FRAMES) if after[i + 1] != lines[i + 1]} == {corrupted[kind] for kind in FAULTS[3:]}
    assert after[corrupted["pose of NaN"] + 1].count("nan") == 7


@pytest.mark.slow
def test_the_recording_is_one_that_a_run_takes(tmp_path: Path) -> None:
    write_recording(tmp_path, frames=12, scale=0.2, steps=2, refine=3)
    frames = list(open_tracker(load_scene(tmp_path / "scene.yaml")))
    assert [frame.index for frame in frames] == list(range(12))
    assert frames[0].image.shape == (48, 64, 3) and frames[8].held_out
    assert min(len(frame.points) for frame in frames) > 10  # what a keyframe needs
    load_scene_text = tmp_path / "kills.yaml"
    load_scene_text.write_text(KILLS_SCENE)
    assert load_scene(load_scene_text).can_be_resumed


def test_a_run_is_killed_when_it_is_time(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(KILLS_SCENE)
    ended = run_until([str(tmp_path / "scene.yaml")], tmp_path / "reference" / "snapshot.npz", kill_after=0.2)
    assert ended.killed and ended.code == -9 and ended.first_snapshot is None
    assert [file.name for file in tmp_path.iterdir()] == ["scene.yaml"]


@pytest.mark.slow
def test_a_run_is_killed_in_the_midst_of_mapping(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(KILLS_SCENE)
    snapshot = tmp_path / "reference" / "snapshot.npz"
    ended = run_until([str(tmp_path / "scene.yaml")], snapshot, kill_after=0.0, mapping=True)
    assert ended.killed and ended.seconds >= ended.first_snapshot and snapshot.is_file()


def test_a_run_that_fails_by_itself_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ended with 2: error: .*gone\.yaml: no such scene file"):
        finished([str(tmp_path / "gone.yaml")], tmp_path)


def test_the_tables_say_what_came_of_it() -> None:
    kills = kills_table(Kills([1.0, 2.0], {"before the first snapshot": 0, "after one": 2}, 1, 1, 0))
    assert "| kills | 2 (0 before the first snapshot, 2 after one) |" in kills
    stage = {"held_out": {"psnr": 30.0}}
    clean = {"frames": 60, "refined": stage, "frames_left_out": {}}
    corrupted = {"frames": 55, "refined": {"held_out": {"psnr": 29.75}}, "frames_left_out": {"blank": 1}}
    stream = Stream(60, {"black image": [9]}, clean, corrupted)
    assert stream.loss == pytest.approx(0.25)
    assert "| lost [dB] | | +0.25 |" in stream_table(stream) and "| left out by the run | | 1 blank |" in stream_table(
        stream
    )
    soak = Soak(100, 5, [10, 20], [110.0, 131.0], [10.0, 30.0])
    assert soak.growth == pytest.approx(100 * 21 / 110) and soak.growth_of_the_rest == pytest.approx(1.0)
    assert "| growth of the rest | | +1.00 % |" in soak_table(soak)


@pytest.mark.slow
def test_an_unknown_part_gets_one_line_and_code_two(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.fault_injection.faults", "thunder", "-o", str(tmp_path / "out")]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert result.returncode == 2
    assert "thunder is none of kills, stream, soak" in result.stderr
    assert not (tmp_path / "out").exists()
