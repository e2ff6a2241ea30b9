"""Tracker `colmap` delivers a model's poses and points in natural order, and names what does not fit."""

from __future__ import annotations

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest

from modp_ti.config.settings import SourceSettings
from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.readers.colmap import ColmapSettings
from tests.opening import opened_with


def plane_points(count: int = 60) -> np.ndarray:
    rng = np.random.default_rng(2)
    return np.c_[rng.uniform(-1.8, 1.8, (count, 2)), np.zeros(count)]


def opened(scene, model=None, **source):
    return opened_with(SourceSettings(path=scene.folder, **source), ColmapSettings(path=model))


def failure(scene, model=None, **source) -> str:
    with pytest.raises(InputError) as caught:
        opened(scene, model, **source)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_frames_come_with_poses_and_points_that_project_onto_their_pixels(plane_scene, text, scale):
    xyz = plane_points()
    plane_scene.write_colmap(xyz, text)
    tracker = opened(plane_scene, scale=scale)
    assert isinstance(tracker, Tracker)
    assert tracker.frame_count == 7
    assert tracker.notes == []
    frames = list(tracker)
    assert [frame.name for frame in frames] == [f"view{i}.png" for i in range(8, 15)]
    for frame, T in zip(frames, plane_scene.T_camera_world, strict=True):
        np.testing.assert_allclose(frame.T_camera_world, T, atol=1e-12)
        assert frame.image.shape == (240 * scale, 320 * scale, 3)
        p = frame.points.xyz @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(frame.camera.project(p), frame.points.pixels, atol=1e-9)
        assert len(frame.points) > 30
        assert frame.mask is None
    by_id: dict[int, np.ndarray] = {}
    for frame in frames:
        for i, x in zip(frame.points.ids, frame.points.xyz, strict=True):
            assert np.array_equal(by_id.setdefault(int(i), x), x), "an id names one point in every frame"
    assert {tuple(x) for x in by_id.values()} <= {tuple(x) for x in xyz}


def test_points_are_undistorted_with_the_lens_of_the_model(plane_scene):
    plane_scene.write_colmap(plane_points())
    folder = plane_scene.folder.parent / "sparse" / "0"
    model = pycolmap.Reconstruction(str(folder))
    K = plane_scene.K
    lens = pycolmap.Camera(
        model="OPENCV",
        width=320,
        height=240,
        params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2], 0.1, -0.05, 0.002, -0.003],
    )
    for image in model.images.values():
        for point in image.points2D:
            ideal = np.linalg.inv(K) @ [*point.xy, 1]
            point.xy = lens.img_from_cam(ideal[None])[0]
    model.cameras[1].model = lens.model
    model.cameras[1].params = lens.params
    model.write_binary(str(folder))
    for frame in opened(plane_scene, scale=0.5):
        T = frame.T_camera_world
        p = frame.points.xyz @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(frame.camera.project(p), frame.points.pixels, atol=1e-6)
        assert frame.mask is not None


def test_indices_times_and_held_out_frames_follow_the_delivered_frames_and_the_folder(plane_scene):
    plane_scene.write_colmap(plane_points())
    frames = list(opened(plane_scene, holdout=2, fps=10, start=1, stop=6, step=2))
    assert [frame.name for frame in frames] == ["view9.png", "view11.png", "view13.png"]
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.held_out for frame in frames] == [True, False, True]
    assert [frame.timestamp for frame in frames] == [0.1, 0.3, 0.5]
    assert not any(frame.held_out for frame in opened(plane_scene))


def test_images_are_decoded_when_their_frame_is_asked_for(plane_scene):
    plane_scene.write_colmap(plane_points())
    frames = iter(opened(plane_scene))
    next(frames)
    (plane_scene.folder / "view9.png").unlink()
    with pytest.raises(InputError, match=r"view9\.png: unreadable image"):
        next(frames)


def test_images_without_pose_and_poses_without_image_are_skipped_with_a_count(plane_scene):
    plane_scene.write_colmap(plane_points())
    (plane_scene.folder / "view9.png").unlink()
    shutil.copy(plane_scene.folder / "view8.png", plane_scene.folder / "view100.png")
    shutil.copy(plane_scene.folder / "view8.png", plane_scene.folder / "view101.png")
    tracker = opened(plane_scene)
    assert [frame.name for frame in tracker.frames] == [f"view{i}.png" for i in (8, 10, 11, 12, 13, 14)]
    assert len(tracker.notes) == 2
    assert tracker.notes[0].startswith("1 images of") and tracker.notes[0].endswith("skipped")
    assert tracker.notes[1].startswith("2 of 8 images have no pose")


def test_poses_and_images_that_do_not_match_are_named(plane_scene):
    folder = plane_scene.write_colmap(plane_points())
    for i, file in enumerate(sorted(plane_scene.folder.iterdir())):
        file.rename(file.with_name(f"other{i}.png"))
    message = failure(plane_scene)
    assert f"{folder}: none of its 7 images is in {plane_scene.folder}" in message
    assert "view" in message and "other0.png" in message


def test_range_without_any_pose_is_named(plane_scene):
    plane_scene.write_colmap(plane_points())
    shutil.copy(plane_scene.folder / "view8.png", plane_scene.folder / "zzz.png")
    assert "no pose for any of the 1 frames" in failure(plane_scene, start=7)
    assert "source.start=99 leaves no frame" in failure(plane_scene, start=99)


def test_size_that_does_not_fit_the_intrinsics_is_named_with_both_sizes_and_the_ratio(plane_scene):
    plane_scene.write_colmap(plane_points())
    file = plane_scene.folder / "view10.png"
    image = cv2.imread(str(file))
    cv2.imwrite(str(file), cv2.resize(image, (160, 120)))
    message = failure(plane_scene)
    assert "view10.png is 160x120" in message and "320x240" in message
    assert "same view at 0.5" in message and "source.scale: 0.5" in message
    cv2.imwrite(str(file), cv2.resize(image, (320, 200)))
    message = failure(plane_scene)
    assert "view10.png is 320x200" in message and "same view" not in message
    cv2.imwrite(str(file), cv2.resize(image, (240, 320)))
    assert "lies on its side" in failure(plane_scene)


def test_image_that_was_cut_off_is_named_before_the_first_frame(plane_scene):
    plane_scene.write_colmap(plane_points())
    file = plane_scene.folder / "view14.png"
    file.write_bytes(file.read_bytes()[:-50])
    assert "view14.png: unreadable image: the file is cut off" in failure(plane_scene)


def test_points_behind_the_camera_outside_the_image_or_seen_twice_are_left_out(plane_scene):
    folder = plane_scene.write_colmap(plane_points(20))
    model = pycolmap.Reconstruction(str(folder))
    image = next(image for image in model.images.values() if image.name == "view8.png")
    behind, twice, outside = (point for point in list(image.points2D)[:3])
    model.points3D[behind.point3D_id].xyz = [0, 0, -50.0]
    outside.xy = [-3.0, 20.0]
    model.write_binary(str(folder))
    points = next(iter(opened(plane_scene))).points
    assert behind.point3D_id not in points.ids
    assert outside.point3D_id not in points.ids
    assert np.count_nonzero(points.ids == twice.point3D_id) == 1
    assert len(np.unique(points.ids)) == len(points)


def test_model_is_found_beside_and_in_the_image_folder_and_below_the_given_one(plane_scene):
    beside = plane_scene.write_colmap(plane_points())
    assert len(opened(plane_scene)) == 7
    assert len(opened(plane_scene, beside.parent)) == 7
    beside.rename(plane_scene.folder / "sparse")
    assert len(opened(plane_scene)) == 7
    (plane_scene.folder / "sparse").rename(plane_scene.folder.parent / "model")
    assert "set tracker.path" in failure(plane_scene)
    assert len(opened(plane_scene, plane_scene.folder.parent / "model")) == 7


def test_missing_model_and_missing_files_are_named(plane_scene, tmp_path):
    assert "no COLMAP model in" in failure(plane_scene)
    assert "no such folder (tracker.path)" in failure(plane_scene, tmp_path / "gone")
    assert "holds no COLMAP model" in failure(plane_scene, plane_scene.folder)
    folder = plane_scene.write_colmap(plane_points())
    (folder / "images.bin").unlink()
    assert "lacks images" in failure(plane_scene)


def test_unusable_camera_model_is_named_with_the_remedy(plane_scene):
    folder = plane_scene.write_colmap(plane_points(), text=True)
    (folder / "cameras.txt").write_text("1 EUCM 320 240 300 300 160 120 0.5 1.0\n")
    message = failure(plane_scene)
    assert "camera model EUCM is not supported" in message and "image_undistorter" in message


def test_impossible_intrinsics_are_named(plane_scene):
    folder = plane_scene.write_colmap(plane_points(), text=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 320 240 -300 300 160 120\n")
    assert "camera 1 has impossible intrinsics" in failure(plane_scene)


@pytest.mark.parametrize("kind", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("part", [0.0, 0.3, 0.7, 0.999])
def test_binary_model_that_was_cut_off_is_named(plane_scene, kind, part):
    folder = plane_scene.write_colmap(plane_points())
    file = folder / f"{kind}.bin"
    file.write_bytes(file.read_bytes()[: int(part * file.stat().st_size)])
    assert f"{kind}.bin" in failure(plane_scene)


@pytest.mark.parametrize("kind", ["images", "points3D"])
@pytest.mark.parametrize("part", [0.0, 0.5])
def test_text_model_that_was_cut_off_is_named(plane_scene, kind, part):
    folder = plane_scene.write_colmap(plane_points(), text=True)
    file = folder / f"{kind}.txt"
    lines = file.read_text().splitlines(keepends=True)
    file.write_text("".join(lines[: int(part * len(lines))]))
    assert str(folder) in failure(plane_scene)


def _lines(folder, stem):
    return [line for line in (folder / f"{stem}.txt").read_text().splitlines() if not line.startswith("#")]


def _plain(folder):
    """Leave the three files that every COLMAP wrote, and return the lines of images and of their observations."""
    for stem in ("rigs", "frames"):
        (folder / f"{stem}.txt").unlink()
    lines = _lines(folder, "images")
    return lines[::2], lines[1::2]


def _write(folder, stem, lines, end="\n", encoding="utf-8"):
    (folder / f"{stem}.txt").write_text("\n".join(lines) + end, encoding=encoding)


TEXT_FORMS = {
    "as COLMAP": lambda images, seen: [line for pair in zip(images, seen, strict=True) for line in pair],
    "comments and blank lines": lambda images, seen: [
        "# a comment",
        "",
        *(line for image, observed in zip(images, seen, strict=True) for line in (image, observed, "")),
    ],
}


@pytest.mark.parametrize("form", TEXT_FORMS)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_text_model_is_read_in_any_form(plane_scene, form, encoding):
    folder = plane_scene.write_colmap(plane_points(), text=True)
    expected = opened(plane_scene).frames
    _write(folder, "images", TEXT_FORMS[form](*_plain(folder)), encoding=encoding)
    for stem in ("cameras", "points3D"):
        _write(folder, stem, _lines(folder, stem), encoding=encoding)
    for a, b in zip(expected, opened(plane_scene).frames, strict=True):
        np.testing.assert_allclose(a.T_camera_world, b.T_camera_world, atol=1e-12)
        np.testing.assert_array_equal(a.points.xyz, b.points.xyz)


def test_names_of_a_text_model_run_to_the_end_of_the_line(plane_scene):
    folder = plane_scene.write_colmap(plane_points(), text=True)
    images, seen = _plain(folder)
    _write(folder, "images", TEXT_FORMS["as COLMAP"]([line.replace("view", "my  7 view") for line in images], seen))
    for file in list(plane_scene.folder.iterdir()):
        file.rename(file.with_name(f"my  7 {file.name}"))
    assert len(opened(plane_scene).frames) == 7


@pytest.mark.parametrize("end", ["\n", ""])
@pytest.mark.parametrize("blank", [True, False])
def test_images_that_observe_nothing_get_the_points_that_project_into_them(plane_scene, blank, end):
    xyz = plane_points()
    folder = plane_scene.write_colmap(xyz, text=True)
    images, _ = _plain(folder)
    lines = [line for image in images for line in ([image, ""] if blank else [image])]
    _write(folder, "images", lines[:-1] if blank else lines, end)
    tracker = opened(plane_scene)
    assert len(tracker.frames) == 7 and tracker.notes
    for frame in tracker.frames:
        p = frame.points.xyz @ frame.T_camera_world[:3, :3].T + frame.T_camera_world[:3, 3]
        np.testing.assert_allclose(frame.undistorter.camera.project(p), frame.points.pixels, atol=1e-9)
        assert len(frame.points) > 30


@pytest.mark.parametrize("text", [True, False])
def test_points_are_triangulated_where_the_model_has_none(plane_scene, text):
    folder = plane_scene.write_colmap(plane_points(), text=text)
    model = pycolmap.Reconstruction(str(folder))
    for number in list(model.points3D):
        model.delete_point3D(number)
    (model.write_text if text else model.write_binary)(str(folder))
    with_file = opened(plane_scene)
    (folder / f"points3D.{'txt' if text else 'bin'}").unlink()
    for tracker in (with_file, opened(plane_scene)):
        assert tracker.notes
        for frame in tracker.frames:
            assert len(frame.points) > 30
            assert np.median(np.abs(frame.points.xyz[:, 2])) < 0.02, "the points lie on the plane"


@pytest.mark.parametrize("text", [True, False])
def test_points_with_nan_are_left_out_with_a_note(plane_scene, text):
    folder = plane_scene.write_colmap(plane_points(), text=True)
    lines = _lines(folder, "points3D")
    words = lines[3].split()
    if text:
        _write(folder, "points3D", [*lines[:3], " ".join([words[0], "nan", *words[2:]]), *lines[4:]])
    else:
        model = pycolmap.Reconstruction(str(folder))
        model.points3D[int(words[0])].xyz = [0.0, np.inf, 0.0]
        for file in folder.iterdir():
            file.unlink()
        model.write_binary(str(folder))
    tracker = opened(plane_scene)
    assert any(note.startswith("1 of 60 points") for note in tracker.notes)
    assert all(int(words[0]) not in frame.points.ids for frame in tracker.frames)


def test_the_model_of_most_images_is_used_with_a_note(plane_scene):
    folder = plane_scene.write_colmap(plane_points())
    whole = pycolmap.Reconstruction(str(folder))
    folder.rename(folder.with_name("1"))
    folder.mkdir()
    for number in sorted(whole.frames)[3:]:
        whole.deregister_frame(number)
    whole.write_binary(str(folder))
    tracker = opened(plane_scene)
    assert len(tracker.frames) == 7
    assert any("several models" in note for note in tracker.notes)
    assert len(opened(plane_scene, folder).frames) == 3, "a model that is named is meant"


def test_of_two_cameras_the_folder_that_is_given_is_meant(plane_scene):
    folder = plane_scene.write_colmap(plane_points(), text=True)
    images, seen = _plain(folder)
    both = []
    for number, (line, observed) in enumerate(zip(images, seen, strict=True)):
        words = line.split()
        away = [str(number + 100), *words[1:5], "9", "9", "9", words[8]]
        both += [" ".join([*away, f"right/{words[9]}"]), "", " ".join([*words[:9], f"left/{words[9]}"]), observed]
    _write(folder, "images", both)
    points = [" ".join(line.split()[:8]) for line in _lines(folder, "points3D")]
    _write(folder, "points3D", points)
    left = plane_scene.folder.rename(plane_scene.folder.with_name("left"))
    tracker = opened_with(SourceSettings(path=left), ColmapSettings(path=folder))
    for frame, T in zip(tracker.frames, plane_scene.T_camera_world, strict=True):
        np.testing.assert_allclose(frame.T_camera_world, T, atol=1e-9)
    other = left.rename(left.with_name("middle"))
    with pytest.raises(InputError, match=r"are both the image view.*source\.path"):
        opened_with(SourceSettings(path=other), ColmapSettings(path=folder))


def test_model_of_noise_is_refused_without_allocating_for_it(plane_scene):
    folder = plane_scene.write_colmap(plane_points())
    noise = np.random.default_rng(0)
    for kind in ("cameras", "images", "points3D"):
        file = folder / f"{kind}.bin"
        whole = file.read_bytes()
        file.write_bytes(noise.bytes(len(whole)))
        assert f"{kind}.bin" in failure(plane_scene)
        file.write_bytes(whole)


def test_longer_file_than_its_records_is_named(plane_scene):
    folder = plane_scene.write_colmap(plane_points())
    with (folder / "points3D.bin").open("ab") as file:
        file.write(b"12345")
    assert "points3D.bin: 5 bytes too long" in failure(plane_scene)


def test_pose_that_is_none_is_named(plane_scene):
    folder = plane_scene.write_colmap(plane_points(), text=True)
    file = folder / "images.txt"
    lines = file.read_text().splitlines()
    words = lines[-2].split()
    words[6] = "nan"
    file.write_text("\n".join([*lines[:-2], " ".join(words), lines[-1]]) + "\n")
    assert str(folder) in failure(plane_scene)


def test_model_of_a_videos_frames_gives_the_frames_that_it_gives_for_images(plane_scene):
    points = plane_points()
    plane_scene.write_colmap(points)
    expected = list(opened_with(SourceSettings(path=plane_scene.folder), ColmapSettings()))

    video = plane_scene.folder.parent / "room.mkv"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"FFV1"), 30.0, plane_scene.size)
    for name in plane_scene.names:
        writer.write(cv2.imread(str(plane_scene.folder / name)))
    writer.release()
    for first in (0, 1):  # programs that extract frames count from either
        renamed = replace(plane_scene, names=[f"room_{i + first:06d}.png" for i in range(len(plane_scene.names))])
        renamed.write_colmap(points)
        tracker = opened_with(SourceSettings(path=video), ColmapSettings())
        assert len(tracker.notes) == first
        for frame, other in zip(tracker, expected, strict=True):
            assert np.array_equal(frame.image, other.image)
            np.testing.assert_allclose(frame.T_camera_world, other.T_camera_world)
            assert np.array_equal(frame.points.pixels, other.points.pixels)
        tracker.close()
