"""Recordings far from the origin, and whose images change while they are mapped."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from rich.console import Console

from fields.frames.origin import far_origin, shifted
from fields.frames.pose_correction import PoseCorrection
from fields.geometry.se3 import camera_centres
from fields.runtime.backend import initialise
from modp_ti.config.scene_file import load_scene
from modp_ti.engine import session, stages
from modp_ti.engine.mapper import Mapper
from modp_ti.files.errors import InputError
from modp_ti.inputs.point_cloud import read_ply_points
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.formats.trajectory import read_trajectory
from modp_ti.outputs.playback.export_map import ExportOptions, export_map
from modp_ti.outputs.playback.finished_run import open_run
from modp_ti.outputs.progress import ProgressLine
from pipelines.settings import MappingSettings
from tests.fault_injection.recordings import write_recording
from tests.modp_ti.engine.stopped_runs import Stopper
from tests.pipelines.wall import CAMERA, frame

pytestmark = pytest.mark.usefixtures("without_warm_up")

SETTINGS = MappingSettings(optimise={"steps": 6}, densify={"warm_up": 2}, depth={"sources": ["image"]})

FAR = np.array([452_001.0, 5_411_000.0, 430.0])

COUNT = 4


def mapped(folder: Path, offset: np.ndarray) -> tuple[Path, list[np.ndarray], np.ndarray]:
    """Map frames of a world that lies at an offset; returns folder, refined poses, and a render of the last view."""
    initialise("cpu")
    mapper = Mapper(64, 48, SETTINGS, seed=1)
    frames = [shifted(frame(i), offset) for i in range(COUNT)]
    for each in frames:
        mapper.add(each)
    mapper.correct(PoseCorrection(np.array([COUNT - 1]), frames[-1].T_camera_world[None]))
    mapper.finish()
    poses = mapper.trajectory()
    return mapper.save(folder), poses, mapper.render(CAMERA, poses[-1]).colour


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> tuple[tuple, tuple]:
    folder = tmp_path_factory.mktemp("maps")
    return mapped(folder / "near", np.zeros(3)), mapped(folder / "far", FAR)


def test_it_is_the_map_of_the_same_frames_near_the_origin(maps: tuple[tuple, tuple]) -> None:
    (near, near_poses, near_view), (far, far_poses, far_view) = maps
    away = camera_centres(far_poses) - camera_centres(near_poses)
    np.testing.assert_allclose(away, np.tile(FAR, (COUNT, 1)), atol=1e-2)
    assert np.abs(near_view - far_view).mean() < 2e-3
    a, b = (read_splats(out / "splats.ply")["position"] for out in (near, far))
    # Frames far away are rounded otherwise: a Gaussian more or less, by the processor.
    assert len(b) == pytest.approx(len(a), rel=0.01) and np.abs(b).max() < 100.0


def test_what_is_written_lies_in_the_world_of_the_frames(maps: tuple[tuple, tuple], tmp_path: Path) -> None:
    _, (far, poses, _) = maps
    np.testing.assert_allclose(read_trajectory(far / "trajectory.txt")[1], poses, atol=1e-9)
    model = pycolmap.Reconstruction(str(far / "colmap"))
    points = np.array([point.xyz for point in model.points3D.values()])
    assert np.abs(points - FAR).max() < 100.0
    for number, T in zip(sorted(model.images), poses, strict=True):
        np.testing.assert_allclose(model.images[number].cam_from_world().matrix(), T[:3], atol=1e-6)
    origin = json.loads((far / "frames.json").read_text())["origin"]
    assert " ".join(map(repr, origin)).encode() in (far / "splats.ply").read_bytes()[:500]

    (far / "config.yaml").write_text("")
    run = open_run(far)
    np.testing.assert_allclose(camera_centres(run.poses) + origin, camera_centres(poses), atol=1e-6)
    written = export_map(run, "points", tmp_path / "a.ply", ExportOptions(), ProgressLine(Console(quiet=True)))
    assert np.abs(read_ply_points(written) - FAR).max() < 100.0


@pytest.mark.parametrize("offset", [0.0, 3.0, 400.0])
def test_an_ordinary_world_has_no_origin(offset: float) -> None:
    moved = shifted(frame(0), np.full(3, offset))
    assert not far_origin(moved.T_camera_world, moved.points).any()


FRAMES = 12

# The last frame is held out, and so changes no map.
KEEP = ["export.images=true", "source.prefetch=2", "source.holdout=11"]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    write_recording(folder, FRAMES, 0.25, 2, 0)
    session.run_scene(load_scene(folder / "scene.yaml", KEEP))
    return folder


def scores(out: Path) -> dict[str, tuple[str, float]]:
    with (out / "scores.csv").open() as file:
        return {row["name"]: (row["index"], float(row["psnr"])) for row in csv.DictReader(file)}


@pytest.mark.slow
def test_the_other_frames_keep_their_scores_and_pictures(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four images are damaged after they were mapped; a fifth was damaged before, and heals."""
    folder = tmp_path / "meddled"
    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("out"))
    names = [f"{place:06d}.png" for place in (3, 5, 6, 8, 11)]
    gone, cut, inverted, smaller, healing = (folder / "images" / name for name in names)
    image, whole = np.asarray(cv2.imread(str(inverted))), healing.read_bytes()
    healing.write_bytes(whole[:500])

    def meddle() -> None:
        gone.unlink()
        cut.write_bytes(cut.read_bytes()[:500])
        cv2.imwrite(str(inverted), 255 - image)
        cv2.imwrite(str(smaller), image[:-8])
        healing.write_bytes(whole)

    monkeypatch.setattr(stages, "open_observer", lambda *_: Stopper("evaluating the saved map", 1, meddle))
    session.run_scene(load_scene(folder / "scene.yaml", KEEP))
    expected = scores(recording / "out")
    for name in names:
        del expected[name]
        assert not (folder / "out" / "colmap" / "images" / name).exists()
    assert scores(folder / "out") == expected
    for each in expected:
        images = [place / "out" / "colmap" / "images" / each for place in (folder, recording)]
        assert images[0].read_bytes() == images[1].read_bytes()


@pytest.mark.slow
def test_without_any_image_there_are_no_scores_but_the_map(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "lost"
    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("out"))
    monkeypatch.setattr(
        stages,
        "open_observer",
        lambda *_: Stopper("evaluating the saved map", 1, lambda: shutil.rmtree(folder / "images")),
    )
    with pytest.raises(InputError, match="without its scores"):
        session.run_scene(load_scene(folder / "scene.yaml", KEEP))
    assert (folder / "out" / "splats.ply").read_bytes() == (recording / "out" / "splats.ply").read_bytes()
