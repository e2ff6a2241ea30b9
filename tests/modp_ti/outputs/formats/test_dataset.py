"""A run's COLMAP model says what the run knows: read back by pycolmap, and by our own reader as input of a new run."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.inputs.delivered_frames import TrackedPoints
from modp_ti.inputs.readers.colmap import ColmapSettings
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.outputs.formats.dataset import image_names, write_colmap, write_image
from tests.opening import opened_with

CAMERAS = [PinholeCamera(50.0, 51.0, 20.5, 14.0, 40, 30), PinholeCamera(55.0, 55.0, 20.0, 15.0, 40, 30)]
NAMES = ["left/frame2.jpg", "left/frame10.jpg", "right/a.png"]
IDS = np.array([70, 3, 2**40], dtype=np.int64)
XYZ = np.array([[0.2, -0.1, 3.0], [-0.4, 0.3, 4.0], [0.1, 0.5, 2.5]])
SEEN = ([0, 1, 2], [2, 0], [1])  # points that each frame sees
OFF = np.array([[0.5, 0.0], [0.0, -1.0], [0.25, 0.0]])  # what each point's pixels are off by


def poses() -> list[np.ndarray]:
    result = []
    for i in range(3):
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(np.array([0.02, -0.05, 0.1]) * i)[0]
        T[:3, 3] = (0.1 * i, -0.05, 0.2)
        result.append(T)
    return result


def frames() -> list[TrackedFrame]:
    rng = np.random.default_rng(4)
    result = []
    for i, (name, T, seen) in enumerate(zip(NAMES, poses(), SEEN, strict=True)):
        camera = CAMERAS[i // 2]
        pixels = camera.project(XYZ[seen] @ T[:3, :3].T + T[:3, 3]) + OFF[seen]
        mask = np.ones((30, 40), dtype=bool)
        mask[:, :3] = False
        image = (rng.integers(0, 256, (30, 40, 3)) / 255.0).astype(np.float32)
        points = SparsePoints(XYZ[seen], pixels, IDS[seen])
        result.append(
            TrackedFrame(i, 0.1 * i, name, image, camera, T, points, mask=mask if i == 1 else None, held_out=i == 0)
        )
    return result


@pytest.fixture
def tracked() -> TrackedPoints:
    points = TrackedPoints()
    for frame in frames():
        points.add(frame)
    return points


def test_pycolmap_reads_what_was_written(tracked: TrackedPoints, tmp_path: Path) -> None:
    cameras = [CAMERAS[0], CAMERAS[0], CAMERAS[1]]
    write_colmap(tmp_path / "colmap", NAMES, cameras, poses(), tracked)
    model = pycolmap.Reconstruction(str(tmp_path / "colmap"))
    assert [model.images[i].name for i in (1, 2, 3)] == NAMES
    assert len(model.cameras) == 2
    for i, (frame, camera) in enumerate(zip(frames(), cameras, strict=True), start=1):
        image = model.images[i]
        written = model.cameras[image.camera_id]
        assert (written.model.name, written.width, written.height) == ("PINHOLE", 40, 30)
        assert written.params.tolist() == [camera.fx, camera.fy, camera.cx, camera.cy]
        np.testing.assert_allclose(image.cam_from_world().matrix(), frame.T_camera_world[:3], atol=1e-14)
        seen = image.get_observation_points2D()
        np.testing.assert_array_equal([p.xy for p in seen], frame.points.pixels.astype(np.float32))
        np.testing.assert_array_equal([model.points3D[p.point3D_id].xyz for p in seen], frame.points.xyz)
    assert sorted(model.points3D) == [1, 2, 3]
    assert [model.points3D[i].track.length() for i in (1, 2, 3)] == [2, 2, 2]
    for i, off in enumerate(OFF, start=1):
        assert model.points3D[i].error == pytest.approx(np.linalg.norm(off), abs=1e-5)
    # Five observations: each point is off by the same in all frames that see it.
    error = tracked.reprojection_error(cameras, poses())
    assert error == pytest.approx((2 * 0.5 + 2 * 1.0 + 2 * 0.25) / 6, abs=1e-5)


def test_points_have_their_colour_in_frames_that_are_not_held_out(tracked: TrackedPoints, tmp_path: Path) -> None:
    _, second, third = frames()
    write_colmap(tmp_path / "colmap", NAMES, [f.camera for f in frames()], poses(), tracked)
    model = pycolmap.Reconstruction(str(tmp_path / "colmap"))
    for point, (frame, place) in {1: (second, 1), 2: (third, 0), 3: (second, 0)}.items():
        column, row = np.floor(frame.points.pixels[place]).astype(int)
        assert model.points3D[point].color.tolist() == np.round(frame.image[row, column] * 255).tolist()


def test_a_point_of_held_out_frames_alone_is_grey() -> None:
    points = TrackedPoints()
    points.add(frames()[0])
    assert (points.colours == 128).all()


def test_a_point_is_where_it_was_said_to_be_last() -> None:
    points = TrackedPoints()
    first = frames()[0]
    points.add(first)
    moved = SparsePoints(first.points.xyz[1:2] + 0.5, first.points.pixels[1:2], first.points.ids[1:2])
    points.add(TrackedFrame(1, 1.0, "b", first.image, first.camera, first.T_camera_world, moved))
    np.testing.assert_array_equal(points.xyz, XYZ + np.array([[0.0], [0.5], [0.0]]))
    assert points.ids.tolist() == IDS.tolist()


def test_our_own_reader_gives_the_same_frames_back(tracked: TrackedPoints, tmp_path: Path) -> None:
    names = image_names(NAMES, written=True)
    folder = tmp_path / "colmap"
    write_colmap(folder, names, [f.camera for f in frames()], poses(), tracked)
    for name, frame in zip(names, frames(), strict=True):
        write_image(folder, name, frame)
    source = SourceSettings(path=folder / "images", masks=None)
    again = list(opened_with(source, ColmapSettings(path=folder)))
    assert [f.name for f in again] == ["left/frame2.png", "left/frame10.png", "right/a.png"]
    for ours, theirs in zip(again, frames(), strict=True):
        assert ours.camera == theirs.camera
        np.testing.assert_allclose(ours.T_camera_world, theirs.T_camera_world, atol=1e-14)
        np.testing.assert_array_equal(ours.image, theirs.image)
        order = np.argsort([IDS.tolist().index(i) for i in theirs.points.ids])
        np.testing.assert_array_equal(ours.points.xyz, theirs.points.xyz[order])
        np.testing.assert_array_equal(ours.points.pixels, theirs.points.pixels[order].astype(np.float32))
    mask = cv2.imread(str(folder / "masks" / "left" / "frame10.png.png"), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(mask > 0, frames()[1].mask)
    assert [p.name for p in (folder / "masks").rglob("*.png")] == ["frame10.png.png"]


def test_images_of_one_name_and_two_suffixes_stay_two() -> None:
    assert image_names(["a.jpg", "a.png"], written=True) == ["a.jpg.png", "a.png.png"]
    assert image_names(["a.jpg", "a.png"], written=False) == ["a.jpg", "a.png"]
