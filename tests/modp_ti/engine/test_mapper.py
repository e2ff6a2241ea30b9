"""`Mapper` on the views of a small wall."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.geometry.camera import PinholeCamera
from modp_ti.engine.mapper import Mapper
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.formats.trajectory import read_trajectory
from pipelines.settings import MappingSettings
from tests.pipelines.wall import CAMERA, frame

SETTINGS = MappingSettings(optimise={"steps": 10}, densify={"warm_up": 2}, depth={"sources": ["image"]})
HELD_OUT = 3


@pytest.fixture(scope="module")
def mapper(taichi_on_the_cpu: None) -> Mapper:
    """A map of five frames, one of which is held out."""
    mapper = Mapper(64, 48, SETTINGS, seed=1)
    for i in range(5):
        before = mapper.pipeline.gaussians.to_numpy()["position"]
        report = mapper.add(frame(i, held_out=i == HELD_OUT))
        if i == HELD_OUT:
            assert report is None
            np.testing.assert_array_equal(mapper.pipeline.gaussians.to_numpy()["position"], before)
        else:
            assert report.index == i and report.gaussians > len(before)
    return mapper


def psnr(mapper: Mapper, i: int) -> float:
    render = mapper.render(CAMERA, mapper.trajectory()[i]).colour
    return -10 * np.log10(((np.clip(render, 0, 1) - frame(i).image) ** 2).mean())


def test_refinement_improves_all_frames_and_may_come_again(mapper: Mapper) -> None:
    before = np.mean([psnr(mapper, i) for i in range(5)])
    steps = []
    mapper.refine(20, progress=lambda step, _: steps.append(step))
    renders = mapper.pipeline.renderer.view_renders
    mapper.finish()  # done by the refinement
    assert mapper.pipeline.renderer.view_renders == renders
    mapper.refine(5)
    assert steps == list(range(1, 21))
    assert np.mean([psnr(mapper, i) for i in range(5)]) > max(before, 24)


def test_without_a_pose_it_looks_from_the_last_frame(mapper: Mapper) -> None:
    np.testing.assert_array_equal(mapper.render(CAMERA).colour, mapper.render(CAMERA, mapper.trajectory()[-1]).colour)


def test_a_saved_map_is_the_map(mapper: Mapper, tmp_path: Path) -> None:
    (tmp_path / "room").mkdir()
    (tmp_path / "room" / "notes.txt").write_text("mine")
    for _ in range(2):  # a second time over the first
        assert mapper.save(tmp_path / "room") == tmp_path / "room"
    mapper.save(tmp_path / "new" / "room.ply")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["new", "room"]
    assert sorted(p.name for p in (tmp_path / "room").iterdir()) == [
        *(".modp-ti", "colmap", "frames.json", "notes.txt", "splats.ply", "trajectory.txt"),
    ]
    state = mapper.pipeline.gaussians.to_numpy()
    for file in (tmp_path / "room" / "splats.ply", tmp_path / "new" / "room.ply"):
        for name, values in read_splats(file).items():
            np.testing.assert_array_equal(values, state[name])
    times, poses = read_trajectory(tmp_path / "room" / "trajectory.txt")
    np.testing.assert_allclose(times, np.arange(5) / 30)
    np.testing.assert_allclose(poses, mapper.trajectory(), atol=1e-12)
    model = pycolmap.Reconstruction(tmp_path / "room" / "colmap")
    assert (model.num_images(), model.num_points3D()) == (5, 5 * 120)


def test_what_cannot_be_written_is_told(mapper: Mapper, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for name in ("file/room", "file/room.ply"):
        with pytest.raises(InputError, match="cannot be written"):
            mapper.save(tmp_path / name)


def test_frames_out_of_order_or_too_large_change_nothing(mapper: Mapper) -> None:
    count = len(mapper.pipeline.gaussians)
    with pytest.raises(ValueError, match="2 has index 2, the frame before it 4"):
        mapper.add(frame(2))
    large = PinholeCamera(60.0, 60.0, 32.0, 24.0, 65, 48)
    with pytest.raises(ValueError, match="9 is 65x48, the mapper was made for images up to 64x48"):
        mapper.add(replace(frame(9), camera=large, image=np.zeros((48, 65, 3), np.float32)))
    with pytest.raises(ValueError, match="65x48 exceeds"):
        mapper.render(large)
    assert len(mapper.frames) == 5 and len(mapper.pipeline.gaussians) == count


def test_a_correction_moves_the_poses_but_of_no_frame_to_come(mapper: Mapper) -> None:
    index = np.arange(5)
    poses = np.stack(mapper.trajectory())
    with pytest.raises(InputError, match="corrects frame 7 after frame 4"):
        mapper.correct(PoseCorrection(index + 3, poses))
    moved = np.stack([frame(i).T_camera_world for i in range(5)])
    moved[:, :3, 3] += moved[:, :3, :3] @ [0.0, 0.5, 0.0]  # the world half a unit down
    mapper.correct(PoseCorrection(index, moved))
    shift = [T[:3, :3].T @ T[:3, 3] - P[:3, :3].T @ P[:3, 3] for T, P in zip(mapper.trajectory(), poses, strict=True)]
    np.testing.assert_allclose(shift, np.tile([0.0, 0.5, 0.0], (5, 1)), atol=1e-6)


@pytest.mark.parametrize("steps", [-3, 2.5, float("nan"), "5"])
def test_a_refinement_has_a_whole_number_of_steps(mapper: Mapper, steps: object) -> None:
    before = mapper.pipeline.renderer.view_renders
    with pytest.raises((TypeError, ValueError), match=r"^[^\n]+$"):
        mapper.refine(steps)
    assert mapper.pipeline.renderer.view_renders == before


def test_no_time_falls(mapper: Mapper) -> None:
    with pytest.raises(ValueError, match=r"^late .* 0\.0 s, the frame before it 0\.1"):
        mapper.add(replace(frame(5), timestamp=0.0, name="late"))
    assert len(mapper.frames) == 5
