"""A second visit to a painted room, by a tracker with a world of its own."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from rich.console import Console

from fields.frames.origin import shifted_poses
from fields.geometry.se3 import exp_se3, inverse_se3, moved_points, moved_pose
from modp_ti.config.scene_file import load_scene
from modp_ti.engine.session import run_scene
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.run_files import read_masks, read_scores
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.formats.trajectory import read_trajectory, write_trajectory
from modp_ti.outputs.playback.finished_run import open_run
from tests.modp_ti.engine.stopped_runs import kill, resumed_run, stopped_run
from tests.modp_ti.outputs.locating.painted_room import CAMERA, another_room, write_run
from tests.room import Room, RoomRecording, walk, write_colmap

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("without_warm_up")]

# Where the first visit's map lies in its world, and the second tracker's room in its: both are georeferenced.
ORIGIN, AWAY_FROM_ORIGIN = np.array([452_000.0, 5_411_000.0, 430.0]), np.eye(4)
AWAY_FROM_ORIGIN[:3, 3] = -ORIGIN[::-1]
# Similarity from the room to the world of the second tracker.
S_TRACKER_ROOM = AWAY_FROM_ORIGIN @ np.diag([0.37, 0.37, 0.37, 1.0]) @ exp_se3([0.4, -2.0, 1.0, 0.9, -1.7, 0.6])
# Along the same path, and on to where the first visit has not been.
FRAMES, STEP = 11, 0.17
FIRST = 7
# Mean distance of the second visit from the truth [m], in a map whose depths nothing has optimised.
AWAY = 0.03
SCENE = """
source:  {path: images, holdout: 5, fps: 10}
tracker: {kind: colmap, path: sparse/0}
output:  out
device:  cpu
mapping: {sh_degree: 0, optimise: {steps: 1, last_passes: 0}}
refine:  {steps: 0}
export:  {report: true}
"""


@pytest.fixture(scope="module")
def first(made_once: Callable[[str, Callable[[Path], None]], Path], room: Room) -> Path:
    """The output folder of a first visit, with its images."""

    def fill(folder: Path) -> None:
        poses = write_run(room, folder / "out")
        moved_to(ORIGIN, folder / "out")
        (folder / "out" / "colmap" / "images").mkdir()
        for number, T in enumerate(poses):
            _, png = cv2.imencode(".png", room.image(CAMERA, T)[..., ::-1])
            (folder / "out" / "colmap" / "images" / f"{number:04d}").write_bytes(png.tobytes())

    return made_once("a first visit", fill) / "out"


def moved_to(origin: NDArray[np.float64], run: Path) -> None:
    """Move the world of a finished run, as that of a georeferenced recording."""
    times, poses = read_trajectory(run / "trajectory.txt")
    write_trajectory(run / "trajectory.txt", times, shifted_poses(poses, origin))
    model = pycolmap.Reconstruction(str(run / "colmap"))
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), origin))
    model.write_binary(str(run / "colmap"))
    record = json.loads((run / "frames.json").read_text())
    (run / "frames.json").write_text(json.dumps({**record, "origin": origin.tolist()}))


def second_scene(room: Room, folder: Path) -> Path:
    """Write the recording of the second visit, tracked in another world, and return its scene file."""
    recording = RoomRecording(room, CAMERA, walk(FRAMES, step=STEP), seed=1)
    recording.write(folder)
    poses = [moved_pose(S_TRACKER_ROOM, T) for T in recording.T_camera_world]
    xyz, seen, pixels = recording.observations
    names = [f"{number:04d}.png" for number in range(FRAMES)]
    write_colmap(folder / "sparse" / "0", CAMERA, names, poses, moved_points(S_TRACKER_ROOM, xyz), seen, pixels)
    scene = folder / "scene.yaml"
    scene.write_text(SCENE)
    return scene


def content(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def centres(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([inverse_se3(T)[:3, 3] for T in poses])


@pytest.fixture(scope="module")
def second(first: Path, made_once: Callable[[str, Callable[[Path], None]], Path], room: Room) -> Path:
    """The output folder of a second visit, beside its recording and what it said."""

    def fill(folder: Path) -> None:
        before = content(first)
        said = io.StringIO()
        run_scene(load_scene(second_scene(room, folder), [f"onto={first}"]), Console(file=said, width=1000))
        assert content(first) == before, "the first visit is only read"
        (folder / "said").write_text(said.getvalue())

    return made_once("a second visit", fill) / "out"


def test_a_second_visit_lands_in_the_first_one_and_goes_on(first: Path, second: Path) -> None:
    out = open_run(second)
    assert len(out) == FIRST + FRAMES
    np.testing.assert_array_equal(out.record.origin, ORIGIN)
    away = np.linalg.norm(centres(out.poses[FIRST:]) - centres(np.array(walk(FRAMES, step=STEP))), axis=1)
    assert away.mean() < AWAY
    metrics = json.loads((second / "metrics.json").read_text())
    onto = metrics["onto"]
    assert onto["frames"] == FIRST and 3 <= onto["agreeing"] <= onto["located"]
    assert onto["scale"] == pytest.approx(1 / 0.37, rel=0.02)
    assert (
        f"joined to {first}: {onto['agreeing']} of {onto['located']} located frames agree"
        in (second.parent / "said").read_text()
    )

    # Nothing of the two visits collides.
    assert (np.diff(out.timestamps) > 0).all()
    assert out.names == [f"{i:04d}" for i in range(FIRST)] + [f"visit2/{i:04d}.png" for i in range(FRAMES)]
    scores = read_scores(second / "scores.csv")
    assert [score.index for score in scores] == list(range(FIRST + FRAMES))
    assert out.record.held_out == [FIRST, FIRST + 5, FIRST + 10]
    assert set(range(FIRST)) < set(out.record.keyframes), "the first visit's keyframes, and new ones"

    # The map goes on where the first visit ended, which it still shows.
    assert len(out.gaussians["position"]) > len(read_splats(first / "splats.ply")["position"])
    psnr = np.array([score.psnr for score in scores])
    assert psnr[:FIRST].min() > 25 and psnr[FIRST:-3].min() > 25


def test_a_third_visit_that_is_killed_ends_as_one_in_peace(
    second: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It finds the images of both earlier visits, locates the recording again, and comes to the same place.

    The high box is gone, so that keyframes of the earlier visits are masked.
    """
    scene = second_scene(Room(without=[2]), tmp_path)
    plain = ["snapshot_every=2", "source.stop=9", "export.report=false", "evaluation.scores=false"]
    config = load_scene(scene, [f"onto={second}", *plain])
    peace = run_scene(config).rename(tmp_path / "peace")
    names = open_run(second).names
    assert open_run(peace).names == names + [f"visit3/{number:04d}.png" for number in range(9)]

    masks = read_masks(peace / "masks")
    assert masks and all(place < len(names) for place in masks)

    out = tmp_path / "out"
    stopped_run(monkeypatch, lambda: run_scene(config), "mapping", 4, kill)
    resumed_run(out)
    for name in ("splats.ply", "trajectory.txt"):
        assert (out / name).read_bytes() == (peace / name).read_bytes(), name
    for place, mask in read_masks(out / "masks").items():
        np.testing.assert_array_equal(mask, masks.pop(place))
    assert not masks


def test_a_recording_of_another_place_is_refused_in_one_line(first: Path, tmp_path: Path) -> None:
    scene = second_scene(another_room(), tmp_path)
    with pytest.raises(InputError, match=r"^onto: 0 of [^\n]+$"):
        run_scene(load_scene(scene, [f"onto={first}"]))
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match=r"\(onto\)"):  # the first visit is not written to
        run_scene(load_scene(scene, [f"onto={first}", f"output={first}"]))
