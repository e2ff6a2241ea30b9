"""What is particular to tracker `colmap`: forms of models, lenses, what is left out, and models that are none."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from tests.opening import assert_poses, off_pixels, opened, refusal
from tests.samples.filmed import Filmed, write_text
from tests.samples.kinds import write_sample
from tests.samples.trackers import colmap_text, write_images


@pytest.fixture
def folder(filmed: Filmed, tmp_path: Path) -> Path:
    """A folder of images with a binary model."""
    write_sample("colmap", tmp_path / "a", filmed)
    return tmp_path / "a"


@pytest.fixture
def text(filmed: Filmed, tmp_path: Path) -> Path:
    """A folder of images with a text model."""
    write_sample("colmap_text", tmp_path / "a", filmed)
    return tmp_path / "a"


def lines_of(folder: Path, stem: str) -> list[str]:
    return (folder / f"sparse/0/{stem}.txt").read_text().splitlines()


def write(folder: Path, stem: str, lines: list[str], encoding: str = "utf-8") -> None:
    (folder / f"sparse/0/{stem}.txt").write_text("\n".join(lines) + "\n", encoding=encoding)


def assert_seen(tracker, filmed: Filmed) -> None:
    assert_poses(tracker.frames, filmed.views, atol=1e-9)
    for frame in tracker.frames:
        assert len(frame.points) > 30 and off_pixels(frame).max() < 1e-6


def test_an_id_names_one_point_in_every_frame_at_any_scale(folder, filmed):
    tracker = opened(folder, "source.scale=0.5")
    assert_seen(tracker, filmed)
    for frame in tracker.frames:
        np.testing.assert_allclose(frame.points.xyz, filmed.points[frame.points.ids - 1])


def test_points_are_undistorted_with_the_lens_of_the_model(folder, filmed):
    model = pycolmap.Reconstruction(str(folder / "sparse/0"))
    (fx, _, cx), (_, fy, cy), _ = filmed.K.tolist()
    lens = pycolmap.Camera(model="OPENCV", width=320, height=240, params=[fx, fy, cx, cy, 0.1, -0.05, 0.002, -0.003])
    for image in model.images.values():
        for point in image.points2D:
            point.xy = lens.img_from_cam((np.linalg.inv(filmed.K) @ [*point.xy, 1])[None])[0]
    model.cameras[1].model, model.cameras[1].params = lens.model, lens.params
    model.write_binary(str(folder / "sparse/0"))
    for frame in opened(folder, "source.scale=0.5"):
        assert frame.mask is not None and off_pixels(frame).max() < 1e-6


def test_indices_times_and_held_out_frames_follow_the_delivered_frames_and_the_folder(folder, filmed):
    settings = ("source.holdout=2", "source.fps=10", "source.start=1", "source.stop=6", "source.step=2")
    frames = list(opened(folder, *settings))
    assert [frame.name for frame in frames] == [filmed.names[i] for i in (1, 3, 5)]
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.held_out for frame in frames] == [True, False, True]
    assert [frame.timestamp for frame in frames] == [0.1, 0.3, 0.5]


def test_images_and_poses_without_the_other_are_skipped_with_a_count(folder, filmed):
    (folder / "images" / filmed.names[1]).unlink()
    for name in ("view100.png", "view101.png"):
        shutil.copy(folder / "images" / filmed.names[0], folder / "images" / name)
    tracker = opened(folder)
    assert [frame.name for frame in tracker.frames] == [name for name in filmed.names if name != filmed.names[1]]
    assert tracker.notes[0].startswith("1 images of") and tracker.notes[1].startswith("2 of 8 images have no pose")
    assert "no pose for any of the 1 selected frames" in refusal(folder, "source.start=6", "source.step=9")
    for i, file in enumerate(sorted((folder / "images").iterdir())):
        file.rename(file.with_name(f"other{i}.png"))
    assert "view8.png" in refusal(folder) and "other0.png" in refusal(folder)


def test_points_behind_the_camera_outside_the_image_or_seen_twice_are_left_out(folder):
    model = pycolmap.Reconstruction(str(folder / "sparse/0"))
    image = next(image for image in model.images.values() if image.name == "view8.png")
    behind, twice, outside = list(image.points2D)[:3]
    model.points3D[behind.point3D_id].xyz = [0, 0, -50.0]
    outside.xy = [-3.0, 20.0]
    model.write_binary(str(folder / "sparse/0"))
    ids = next(iter(opened(folder))).points.ids
    assert behind.point3D_id not in ids and outside.point3D_id not in ids
    assert np.count_nonzero(ids == twice.point3D_id) == 1


def test_the_model_is_found_near_the_images_and_below_the_given_folder(folder):
    (folder / "sparse").rename(folder / "images/sparse")
    assert len(opened(folder)) == 7
    (folder / "images/sparse").rename(folder / "model")
    assert "set tracker.path" in refusal(folder)
    for place in ("model", "model/0"):
        assert len(opened(folder, f"tracker.path={folder / place}")) == 7
    assert "no such folder (tracker.path)" in refusal(folder, f"tracker.path={folder / 'gone'}")
    assert "holds no COLMAP model" in refusal(folder, f"tracker.path={folder / 'images'}")


@pytest.mark.parametrize("camera", ["EUCM 320 240 300 300 160 120 0.5 1.0", "PINHOLE 320 240 -300 300 160 120"])
def test_a_camera_that_cannot_be_used_is_named(text, camera):
    write(text, "cameras", [f"1 {camera}"])
    assert str(text / "sparse/0") in refusal(text)


@pytest.mark.parametrize("kind", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("part", [0.0, 0.3, 0.7, 0.999, 1.01])
def test_a_binary_model_of_another_length_than_its_records_is_named(folder, kind, part):
    file = folder / f"sparse/0/{kind}.bin"
    data = file.read_bytes()
    file.write_bytes(data[: int(part * len(data))] if part < 1 else data + b"12345")
    assert f"{kind}.bin" in refusal(folder)


@pytest.mark.parametrize("kind", ["images", "points3D"])
@pytest.mark.parametrize("part", [0.0, 0.5])
def test_a_text_model_that_was_cut_off_is_named(text, kind, part):
    lines = lines_of(text, kind)
    write(text, kind, lines[: int(part * len(lines))])
    assert str(text / "sparse/0") in refusal(text)


def test_a_text_model_may_have_comments_blank_lines_and_blanks_in_names(text, filmed):
    names = [f"my  7 {name}" for name in filmed.names]
    shutil.rmtree(text / "images")
    write_images(text, filmed, names=names)
    colmap_text(text, filmed, names)
    lines = lines_of(text, "images")
    pairs = zip(lines[::2], lines[1::2], strict=True)
    write(text, "images", ["# a comment", "", *(line for pair in pairs for line in (*pair, ""))])
    assert_seen(opened(text), filmed)


@pytest.mark.parametrize("blank", [True, False])
def test_images_that_observe_nothing_get_the_points_that_project_into_them(text, filmed, blank):
    write(
        text,
        "images",
        [line for image in lines_of(text, "images")[::2] for line in ([image, ""] if blank else [image])],
    )
    tracker = opened(text)
    assert tracker.notes
    assert_seen(tracker, filmed)


@pytest.mark.slow
def test_points_are_triangulated_where_the_model_has_none(text):
    (text / "sparse/0/points3D.txt").unlink()
    write(text, "images", [line for image in lines_of(text, "images")[::2] for line in (image, "")])
    tracker = opened(text)
    assert tracker.notes
    for frame in tracker.frames:
        assert len(frame.points) > 30
        assert np.median(np.abs(frame.points.xyz[:, 2])) < 0.02, "the points lie on the plane"


def test_points_with_nan_are_left_out_with_a_note(text):
    lines = lines_of(text, "points3D")
    number, _, *rest = lines[30].split()
    write(text, "points3D", [*lines[:30], " ".join([number, "nan", *rest]), *lines[31:]])
    tracker = opened(text)
    assert any(note.startswith("1 of 60 points") for note in tracker.notes)
    assert all(int(number) not in frame.points.ids for frame in tracker.frames)


def test_the_model_of_most_images_is_used_with_a_note(folder):
    place = folder / "sparse/0"
    whole = pycolmap.Reconstruction(str(place))
    place.rename(place.with_name("1"))
    place.mkdir()
    for number in sorted(whole.frames)[3:]:
        whole.deregister_frame(number)
    whole.write_binary(str(place))
    tracker = opened(folder)
    assert len(tracker.frames) == 7
    assert any("several models" in note for note in tracker.notes)
    assert len(opened(folder, f"tracker.path={place}").frames) == 3, "a model that is named is meant"


def test_of_two_cameras_the_folder_that_is_given_is_meant(text, filmed):
    lines, both = lines_of(text, "images"), []
    for line, observed in zip(lines[::2], lines[1::2], strict=True):
        words = line.split()
        away = [str(int(words[0]) + 100), *words[1:5], "9", "9", "9", words[8]]
        both += [" ".join([*away, f"right/{words[9]}"]), "", " ".join([*words[:9], f"left/{words[9]}"]), observed]
    write(text, "images", both)
    write(text, "points3D", [" ".join(line.split()[:8]) for line in lines_of(text, "points3D")])
    (text / "images").rename(text / "left")
    assert_seen(opened(text, f"source.path={text / 'left'}", f"tracker.path={text / 'sparse'}"), filmed)
    (text / "left").rename(text / "middle")
    assert "are both the image view" in refusal(
        text, f"source.path={text / 'middle'}", f"tracker.path={text / 'sparse'}"
    )


@pytest.mark.parametrize("first", [0, 1])
def test_a_model_of_a_videos_frames_gives_those_that_it_gives_for_images(text, filmed, first):
    """Programs that extract frames count from either."""
    expected = list(opened(text))
    writer = cv2.VideoWriter(str(text / "room.mkv"), cv2.VideoWriter.fourcc(*"FFV1"), 30.0, filmed.size)
    for view in filmed.views:
        writer.write(view.image)
    writer.release()
    colmap_text(text, filmed, [f"room_{i + first:06d}.png" for i in range(7)])
    tracker = opened(text, f"source.path={text / 'room.mkv'}", f"tracker.path={text / 'sparse/0'}")
    assert len(tracker.notes) == first
    for frame, other in zip(tracker, expected, strict=True):
        assert np.array_equal(frame.image, other.image)
        np.testing.assert_allclose(frame.T_camera_world, other.T_camera_world)
        assert np.array_equal(frame.points.pixels, other.points.pixels)
    tracker.close()


def test_a_pose_that_is_none_is_named(text):
    lines = lines_of(text, "images")
    words = lines[-2].split()
    write(text, "images", [*lines[:-2], " ".join([*words[:6], "nan", *words[7:]]), lines[-1]])
    assert str(text / "sparse/0") in refusal(text)
    write_text(text / "sparse/0/cameras.txt", ["1 EQUIRECTANGULAR 320 240 320 240"])
    assert "source.panorama" in refusal(text)
