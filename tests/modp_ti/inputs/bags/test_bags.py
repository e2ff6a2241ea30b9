"""Bags of ROS 1 and ROS 2 deliver the images, cameras, poses and points that they were made with."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import av
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation

from modp_ti.config.bare_recording import recorded_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.bags import has_poses, is_bag
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.source_settings import SourceSettings
from tests.opening import assert_poses, off_pixels
from tests.samples.bags import BODY_CAMERA, FORMS, START, STEP, Messages, recording, write_bag

PLANE = np.stack(np.meshgrid(np.linspace(-3, 3, 40), np.linspace(-3, 3, 40), [0.0]), axis=-1).reshape(-1, 3)


def place(form: str) -> str:
    return "room.bag" if form == "ros1" else "room"


def with_cloud(views, form, xyz=PLANE):
    return [*recording(views, form), ("/map", START, Messages(form).cloud(START, xyz.astype("<f4")))]


@pytest.mark.parametrize("form", FORMS)
def test_images_cameras_poses_and_points_are_those_that_were_recorded(form, views, tmp_path, opened):
    path = write_bag(tmp_path / place(form), form, with_cloud(views, form))
    tracker = opened(path, "bag", {"scale": 1, "holdout": 4})
    assert_poses(tracker.frames, views)
    for n, (frame, posed, view) in enumerate(zip(tracker, tracker.frames, views, strict=True)):
        np.testing.assert_array_equal(frame.image, view.image[..., ::-1] / np.float32(255))
        np.testing.assert_allclose(posed.undistorter.raw.matrix(), view.K, atol=1e-12)
        assert frame.timestamp == pytest.approx((START + n * STEP) * 1e-9, abs=1e-6)
        assert frame.held_out == (n % 4 == 0)
        assert len(frame.points) > 50 and off_pixels(frame).max() < 1e-6 and np.abs(frame.points.xyz[:, 2]).max() < 1e-6


PACKED = [("ros1", "bz2"), ("ros1", "lz4"), ("sqlite3", "message"), ("mcap", "storage")]


@pytest.mark.parametrize(("form", "packed"), PACKED)
def test_packed_bags_are_read(form, packed, views, tmp_path, opened, untriangulated):
    path = write_bag(tmp_path / place(form), form, recording(views[:2], form), packed)
    tracker = opened(path, "bag")
    assert_poses(tracker.frames, views[:2])
    assert len(list(tracker)) == 2


@pytest.mark.parametrize("form", FORMS)
def test_a_bag_alone_is_recognised_and_tracked_by_its_own_poses(form, views, tmp_path):
    path = write_bag(tmp_path / place(form), form, recording(views[:1], form))
    assert recorded_scene(path).tracker.kind == "bag" and is_bag(path)
    assert recorded_scene(path, ["tracker.kind=klt"]).tracker.kind == "klt"
    files = [path] if form == "ros1" else [file for file in path.iterdir() if file.suffix != ".yaml"]
    assert recorded_scene(files[0]).tracker.kind == "bag"


def test_a_bag_without_poses_is_tracked_by_its_images(views, tmp_path, opened):
    bare = [each for each in recording(views[:2]) if each[0].startswith("/camera") or each[0] == "/tf_static"]
    path = write_bag(tmp_path / "room", "mcap", bare)
    assert recorded_scene(path).tracker.kind == "klt" and not has_poses(path)
    images = open_source(SourceSettings(path=path))
    np.testing.assert_array_equal(images.read("room_000001"), views[1].image[..., ::-1])
    np.testing.assert_array_equal(images.read("room_000000"), views[0].image[..., ::-1])
    with pytest.raises(InputError, match=r"holds no poses: set tracker.kind: klt"):
        opened(path, "bag", world="odom")
    images.close()


def test_poses_by_the_tf_tree_are_those_by_odometry(views, tmp_path, opened, untriangulated):
    messages = [each for each in recording(views) if each[0] != "/odom"]
    path = write_bag(tmp_path / "room", "mcap", messages)
    tracker = opened(path, "bag")
    assert_poses(tracker.frames, views)
    assert any("poses of optical in odom by the tf tree" in note for note in tracker.notes)
    for a, b in zip(
        opened(path, "bag", world="base").frames, opened(path, "bag", world="base", pose="tf").frames, strict=True
    ):
        np.testing.assert_array_equal(a.T_camera_world, b.T_camera_world)
        np.testing.assert_allclose(a.T_camera_world, np.linalg.inv(BODY_CAMERA), atol=1e-12)


def test_images_outside_the_poses_times_are_skipped_and_told_once(views, tmp_path, opened, untriangulated):
    messages = [each for each in recording(views) if each[0] != "/tf"]
    kept = [each for each in messages if each[0] != "/odom" or STEP < each[1] - START < 5 * STEP]
    tracker = opened(write_bag(tmp_path / "room", "mcap", kept), "bag")
    assert_poses(tracker.frames, views[1:5])
    assert sum("3 of 7 images" in note for note in tracker.notes) == 1


def test_images_between_poses_have_interpolated_ones_unless_the_gap_is_long(views, tmp_path, opened, untriangulated):
    """Every second pose is there, and the others lie half-way between those beside them."""
    between = list(views[:5])
    for n in (1, 3):
        before, after = (views[n + d].T_world_camera @ np.linalg.inv(BODY_CAMERA) for d in (-1, 1))
        between[n] = replace(views[n], T_world_camera=halfway(before, after) @ BODY_CAMERA)
    messages = recording(between)
    odometry = [each for each in messages if each[0] == "/odom"][::2]
    rest = [each for each in messages if each[0] not in ("/odom", "/tf")]
    path = write_bag(tmp_path / "room", "mcap", [*rest, *odometry])
    assert_poses(opened(path, "bag").frames, between, atol=2e-6)  # times since 1970 have steps of 0.24 us in float64
    assert_poses(opened(path, "bag", max_gap=0.15).frames, between[::2])


def halfway(a, b):
    """The pose between two: the mean of the positions, and half of the turn."""
    T = np.eye(4)
    turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
    T[:3, :3] = a[:3, :3] @ Rotation.from_rotvec(turn / 2).as_matrix()
    T[:3, 3] = (a[:3, 3] + b[:3, 3]) / 2
    return T


def test_poses_of_the_camera_itself_need_no_transforms(views, tmp_path, opened, untriangulated):
    make = Messages()
    images = [each for each in recording(views[:3]) if each[0].startswith("/camera")]
    times = [START + n * STEP for n in range(3)]
    poses = [("/pose", t, make.pose_stamped(t, v.T_world_camera)) for t, v in zip(times, views, strict=False)]
    tracker = opened(write_bag(tmp_path / "room", "mcap", [*images, *poses]), "bag")
    assert_poses(tracker.frames, views[:3])
    assert any("/pose, which does not say of what: of optical (tracker.body)" in note for note in tracker.notes)


def test_topics_are_chosen_by_name(views, tmp_path, opened, untriangulated):
    make = Messages()
    messages = recording(views[:2])
    for n, view in enumerate(views[:2]):
        time = START + n * STEP
        grey = make.image(time, view.image[::2, ::2, 0], "mono8", "other")
        messages.append(("/alone/image", time, grey))
        moved = view.T_world_camera.copy()
        moved[:3, 3] += 1.0
        messages.append(("/another", time, make.odometry(time, moved, child="other")))
    path = write_bag(tmp_path / "room", "mcap", messages)
    tracker = opened(path, "bag")
    assert_poses(opened(path, "bag", pose="/odom").frames, views[:2])
    assert any("there are also /alone/image (source.bag.image)" in note for note in tracker.notes)
    assert any("there are also /odom (tracker.pose)" in note for note in tracker.notes)
    other = {"bag": {"image": "/alone/image", "camera_info": "/camera/camera_info"}, "intrinsics": {"fx": 150}}
    frames = opened(path, "bag", other, pose="/another").frames
    assert (frames[0].undistorter.raw.width, frames[0].undistorter.raw.fx) == (160, 150)
    np.testing.assert_allclose(np.linalg.inv(frames[0].T_camera_world)[:3, 3], views[0].T_world_camera[:3, 3] + 1.0)
    for wrong, setting in (({"pose": "/map"}, "tracker.pose"), ({"points": "/odom"}, "tracker.points")):
        with pytest.raises(InputError, match=rf"at {next(iter(wrong.values()))}; there is .* \({setting}\)"):
            opened(path, "bag", **wrong)


def test_a_cloud_that_leads_nowhere_is_told_and_points_are_triangulated(views, tmp_path, opened):
    lost = ("/scan", START, Messages().cloud(START, PLANE.astype("<f4"), "velodyne"))
    path = write_bag(tmp_path / "room", "mcap", [*recording(views[:4]), lost])
    tracker = opened(path, "bag")
    assert any("'velodyne' to 'odom' at its time (tracker.points): points are triang" in note for note in tracker.notes)
    assert np.median(np.abs(np.concatenate([frame.points.xyz[:, 2] for frame in tracker.frames]))) < 0.02
    with pytest.raises(InputError, match="no cloud of /scan has points"):
        opened(path, "bag", points="/scan")


@pytest.mark.parametrize("topic", ["/goal_pose", "/initialpose", "/mavros/setpoint_position/local", "/waypoint"])
def test_where_a_robot_should_go_is_no_pose_of_it(topic, views, tmp_path, opened, untriangulated):
    make, images = Messages(), [each for each in recording(views) if each[0] != "/odom"]
    goals = [(topic, START + n * STEP, make.pose_stamped(START + n * STEP, np.eye(4))) for n in range(3)]
    path = write_bag(tmp_path / "room", "mcap", [*images, *goals])
    assert_poses(opened(path, "bag").frames, views)
    assert opened(path, "bag", pose=topic, camera="optical").frames  # unless the user says so
    still = [each for each in images if each[0] not in ("/tf", "/tf_static")]
    assert not has_poses(write_bag(tmp_path / "still", "mcap", [*still, *goals]))


@pytest.mark.parametrize("kind", ["sensor_msgs/CompressedImage", "foxglove_msgs/CompressedVideo"])
@pytest.mark.parametrize(("codec", "said"), [("libx264", "h264"), ("libx265", "h265")])
def test_video_in_messages_is_decoded_from_its_first_keyframe(kind, codec, said, views, tmp_path):
    """FFmpeg decodes the same stream. The recording begins amid a group of pictures."""
    context = av.CodecContext.create(codec, "w")
    context.width, context.height, context.pix_fmt = *views[0].size, "yuv420p"
    context.time_base, context.gop_size = Fraction(1, 10), 4
    context.options = {"bf": "0", "tune": "zerolatency"} | ({"x265-params": "log-level=none"} if said == "h265" else {})
    packets: list[bytes] = []
    for image in (view.image for view in (*views, *views)):
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image[..., ::-1]), format="rgb24")
        frame.pts = len(packets)
        packets += map(bytes, context.encode(frame))
    packets += map(bytes, context.encode(None))
    whole = av.CodecContext.create(said.replace("h265", "hevc"), "r")
    decoded = [frame.to_ndarray(format="rgb24") for packet in packets for frame in whole.decode(av.Packet(packet))]
    decoded += [frame.to_ndarray(format="rgb24") for frame in whole.decode(None)]
    make = Messages()
    text = "std_msgs/Header header\nuint8[] data\nstring format"
    make.store.register(get_types_from_msg(text, "foxglove_msgs/msg/CompressedVideo"))
    messages = []
    for n, packet in list(enumerate(packets))[1:]:
        time, data = START + n * STEP, np.frombuffer(packet, np.uint8)
        values = (said, data) if "Image" in kind else (data, said)
        messages.append(("/video", time, make.make(kind, make.header(time, "optical"), *values)))
    images = open_source(SourceSettings(path=write_bag(tmp_path / "room", "mcap", messages, store=make.store)))
    assert len(images) == len(packets) - 4
    for n in (0, 5, 2):
        found = images.read(images.names[n]).astype(int)
        assert np.abs(found - decoded[n + 4]).mean() < 1.0
        assert images.timestamp(images.names[n]) == pytest.approx((START + (n + 4) * STEP) * 1e-9, abs=1e-6)
    images.close()


@pytest.mark.parametrize("form", ["mcap", "sqlite3"])
def test_a_folder_that_holds_only_a_bag_is_one(form, views, tmp_path):
    path = write_bag(tmp_path / "room", form, recording(views[:1], form))
    (path / "metadata.yaml").unlink()
    assert recorded_scene(path).tracker.kind == "bag"


def test_the_camera_of_realsense_viewer_lies_one_folder_aside(views, tmp_path):
    at = {
        "/camera/image_raw": "/device_0/Color_0/image/data",
        "/camera/camera_info": "/device_0/Color_0/info/camera_info",
    }
    messages = [(at[topic], *rest) for topic, *rest in recording(views[:1], "ros1") if topic in at]
    wrong = Messages("ros1").info(START, 2 * views[0].K, views[0].size)
    messages.append(("/device_0/Depth_0/info/camera_info", START, wrong))
    images = open_source(SourceSettings(path=write_bag(tmp_path / "room.bag", "ros1", messages)))
    assert images.intrinsics is not None
    np.testing.assert_allclose(images.intrinsics.camera.matrix(), views[0].K)
    images.close()
