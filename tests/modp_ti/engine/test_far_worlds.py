"""A map of georeferenced frames is that of the same frames near the origin, and is written in their world."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from rich.console import Console

from fields.frames.origin import far_origin, shifted
from fields.frames.pose_correction import PoseCorrection
from fields.geometry.se3 import camera_centres
from fields.runtime.backend import initialise
from modp_ti.engine.mapper import Mapper
from modp_ti.inputs.point_cloud import read_ply_points
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.formats.trajectory import read_trajectory
from modp_ti.outputs.playback.export_map import ExportOptions, export_map
from modp_ti.outputs.playback.finished_run import open_run
from modp_ti.outputs.progress import ProgressLine
from pipelines.settings import MappingSettings
from tests.pipelines.wall import CAMERA, frame

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
