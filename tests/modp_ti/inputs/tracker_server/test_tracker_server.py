"""What comes through the server is what the mapper gets, and where the server is."""

from __future__ import annotations

import shutil
import socket
import stat
import struct
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.readers.colmap import ColmapSettings
from modp_ti.inputs.readers.socket import SocketSettings
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.inputs.tracker_server import TrackerServer
from tests.modp_ti.inputs.tracker_server.clients import (
    CORRECTION,
    DONE,
    END,
    FRAME,
    HELLO,
    POSE,
    SIZE,
    WELCOME,
    answer,
    colours,
    connect,
    correction,
    frame,
    greeted,
    hello,
    late,
    message,
    opened,
    point,
    pose,
)
from tests.opening import opened_with


def test_frames_come_out_as_they_were_sent(tmp_path: Path) -> None:
    picture = np.arange(SIZE[0] * SIZE[1] * 3, dtype=np.uint8).reshape(SIZE[1], SIZE[0], 3)
    points = point(7, 0.5, 0.25, 2.0, 6.0, 4.0) + point(2**40, 0, 0, -1, 3.0, 3.0) + point(3, 0, 0, 5, 4.0, 3.0)
    with opened(tmp_path / "s", holdout=2) as tracker:
        assert isinstance(tracker, Tracker)
        with greeted(tmp_path / "s") as connection:
            connection.sendall(message(FRAME, frame(5, points=points, image=picture.tobytes())))
            connection.sendall(message(FRAME, frame(9)) + message(END))
            assert answer(connection) == (DONE, struct.pack("<I", 2))
        first, second = list(tracker)
    assert (first.index, first.timestamp, first.held_out) == (0, 0.5, True)
    assert (second.index, second.timestamp, second.held_out) == (1, 0.1 * 9, False)
    np.testing.assert_array_equal(first.rgba[..., :3], picture)
    assert first.mask is None
    np.testing.assert_array_equal(first.T_camera_world, pose(0.5))
    c = first.camera
    assert (c.fx, c.fy, c.cx, c.cy, c.width, c.height) == (9.0, 9.5, 4.0, 3.0, 8, 6)
    # A point behind the camera is none that it sees.
    assert first.points.ids.tolist() == [7, 3]
    np.testing.assert_array_equal(first.points.xyz, [[0.5, 0.25, 2], [0, 0, 5]])
    np.testing.assert_array_equal(first.points.pixels, [[6, 4], [4, 3]])


def test_a_lens_and_a_scale_are_treated_as_the_colmap_reader_does(plane_scene, tmp_path: Path) -> None:
    import pycolmap

    rng = np.random.default_rng(2)
    folder = plane_scene.write_colmap(np.c_[rng.uniform(-1.8, 1.8, (60, 2)), np.zeros(60)])
    model = pycolmap.Reconstruction(str(folder))
    K, k = plane_scene.K, [0.1, -0.05, 0.002, -0.003]
    intrinsics = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    lens = pycolmap.Camera(model="OPENCV", width=320, height=240, params=[*intrinsics, *k])
    model.cameras[1].model, model.cameras[1].params = lens.model, lens.params
    model.write_binary(str(folder))
    source = SourceSettings(path=plane_scene.folder, scale=0.5)
    expected = list(opened_with(source, ColmapSettings()))
    with opened(tmp_path / "s", scale=0.5) as tracker, connect(tmp_path / "s") as connection:
        start = struct.pack("<IIII12d", 320, 240, 2, 1, *intrinsics, *k, *[0.0] * 4)
        connection.sendall(message(HELLO, start + b"a tracker"))
        by_name = {image.name: image for image in model.images.values()}
        for i, (name, T) in enumerate(zip(plane_scene.names, expected, strict=True)):
            seen = sorted(by_name[name].get_observation_points2D(), key=lambda p: p.point3D_id)
            block = b"".join(point(p.point3D_id, *model.points3D[p.point3D_id].xyz, *p.xy) for p in seen)
            data = (plane_scene.folder / name).read_bytes()
            connection.sendall(message(FRAME, frame(i, T=T.T_camera_world, points=block, image=data)))
        connection.sendall(message(END))
        got = list(tracker)
    assert len(got) == len(expected) == 7
    assert "the tracker there is a tracker" in tracker.notes
    for ours, theirs in zip(got, expected, strict=True):
        assert ours.camera == theirs.camera
        np.testing.assert_array_equal(ours.T_camera_world, theirs.T_camera_world)
        np.testing.assert_array_equal(ours.rgba, theirs.rgba)
        for column in ("ids", "xyz", "pixels"):
            np.testing.assert_array_equal(getattr(ours.points, column), getattr(theirs.points, column))
        assert len(ours.points) > 20


def test_poses_may_come_later_and_frames_keep_their_order(tmp_path: Path) -> None:
    with opened(tmp_path / "s") as tracker, greeted(tmp_path / "s") as connection:
        for number in (1, 2, 4):
            connection.sendall(message(FRAME, frame(number, state=0)))
        connection.sendall(message(FRAME, frame(6)))  # its pose is known before theirs
        connection.sendall(message(FRAME, frame(7, state=2)))  # lost
        connection.sendall(message(POSE, late(4, T=pose(4.0), points=point(1, 0, 0, 3, 4.0, 3.0))))
        connection.sendall(message(POSE, late(2, state=2)))
        connection.sendall(message(POSE, late(1, T=pose(1.0))))
        connection.sendall(message(FRAME, frame(8, state=0)) + message(END))  # nothing comes of the last one
        frames = list(tracker)
        assert answer(connection) == (DONE, struct.pack("<I", 3))
    assert colours(frames) == [1, 4, 6]
    assert [f.index for f in frames] == [0, 1, 2]
    assert [f.timestamp for f in frames] == [0.1, 0.4, 0.1 * 6]
    assert [f.T_camera_world[0, 3] for f in frames] == [1.0, 4.0, 0.1 * 6]
    assert [f.points.ids.tolist() for f in frames] == [[], [1], []]
    assert tracker.notes[-1] == "3 of 6 frames came without a pose: skipped"


def test_a_correction_names_delivered_frames_and_their_images_can_be_read_again(tmp_path: Path) -> None:
    seen = point(5, 0, 0, 3, 4.0, 3.0) + point(6, 0, 0, 4, 4.0, 3.0)
    with opened(tmp_path / "s") as tracker, greeted(tmp_path / "s") as connection:
        connection.sendall(message(FRAME, frame(10, points=seen)) + message(FRAME, frame(11, state=2)))
        connection.sendall(message(FRAME, frame(12)) + message(FRAME, frame(14)) + message(FRAME, frame(15)))
        moved = {10: pose(2.0), 14: pose(3.4)}
        connection.sendall(message(CORRECTION, correction(moved, {5: (1.0, 0, 3), 99: (0, 0, 1)})))
        connection.sendall(message(FRAME, frame(16)) + message(END))
        arrived = list(tracker)
        again = list(tracker.pictures(["000010.rgb8", "gone", "000014.rgb8"]))
    assert [type(e) for e in arrived] == [TrackedFrame] * 4 + [PoseCorrection] + [TrackedFrame]
    revised = arrived[4]
    assert revised.index.tolist() == [0, 2]  # frames by their place among those delivered
    np.testing.assert_array_equal(revised.T_camera_world, [pose(2.0), pose(3.4)])
    assert (revised.ids.tolist(), revised.xyz.tolist()) == ([5, 99], [[1, 0, 3], [0, 0, 1]])
    assert [name for name, _ in again] == ["000010.rgb8", "000014.rgb8"]
    np.testing.assert_array_equal(again[1][1].image, arrived[2].image)


def test_alpha_says_which_pixels_count(tmp_path: Path) -> None:
    rgba = np.full((SIZE[1], SIZE[0], 4), 200, dtype=np.uint8)
    rgba[2, 3, 3] = 0
    png = cv2.imencode(".png", rgba)[1].tobytes()
    for encoding, data in ((5, rgba.tobytes()), (2, png)):
        path = tmp_path / f"s{encoding}"
        with opened(path) as tracker, connect(path) as connection:
            connection.sendall(message(HELLO, hello(encoding=encoding)))
            connection.sendall(message(FRAME, frame(1, image=data)) + message(END))
            (only,) = list(tracker)
        assert not only.mask[2, 3]
        assert only.mask.sum() == SIZE[0] * SIZE[1] - 1
        assert only.rgba[0, 0].tolist() == [200, 200, 200, 255]


def test_a_sender_is_not_held_up_by_a_busy_mapper(tmp_path: Path) -> None:
    with opened(tmp_path / "s", holdout=2) as tracker, greeted(tmp_path / "s") as connection:
        before = time.monotonic()
        for number in range(200):
            connection.sendall(message(FRAME, frame(number, state=2 if number == 100 else 1)))
        connection.sendall(message(END))
        assert answer(connection) == (DONE, struct.pack("<I", 199)), "though the mapper has taken none"
        live = tracker.live
        assert (live.arrived, live.tracked, live.lost, live.thinned, live.waiting) == (200, 199, 1, 0, 199)
        assert before <= live.newest <= time.monotonic()
        events = iter(tracker)
        frames = [next(events) for _ in range(50)]
        assert tracker.live.waiting == 149
        frames += events
        assert colours(frames) == [number for number in range(200) if number != 100]
        arrived = [f.arrived for f in frames]
        assert arrived == sorted(arrived) and before <= arrived[0] and arrived[-1] == live.newest
        assert [f.index for f in frames if f.held_out] == list(range(0, 199, 2))


# ---- what a killed run leaves ---------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", [2, 4])
@pytest.mark.parametrize("lost", [0, 30])
def test_a_stream_that_was_kept_comes_again(encoding: int, lost: int, tmp_path: Path) -> None:
    """The last `lost` bytes had not been written when the run was killed."""
    pictures = [np.random.default_rng(i).integers(0, 255, (SIZE[1], SIZE[0], 3), np.uint8) for i in range(4)]
    sent = [cv2.imencode(".png", each)[1].tobytes() if encoding == 2 else each.tobytes() for each in pictures]
    with opened(tmp_path / "s") as tracker:
        with connect(tmp_path / "s") as connection:
            connection.sendall(message(HELLO, hello(encoding=encoding)))
            connection.sendall(message(FRAME, frame(1, points=point(5, 0, 0, 5, 4, 3), image=sent[0])))
            connection.sendall(message(FRAME, frame(2, state=0, image=sent[1])))
            connection.sendall(message(FRAME, frame(3, image=b"none" if encoding == 2 else sent[2][:-1])))  # refused
            connection.sendall(message(POSE, late(2)) + message(CORRECTION, correction({1: pose(0.3)}, {5: (0, 0, 6)})))
            connection.sendall(message(FRAME, frame(4, image=sent[3])) + message(END))
            assert answer(connection)[0] == WELCOME
            assert answer(connection)[0] == DONE
        expected = list(tracker)
        shutil.copytree(Path(tracker.kept["tracker"]["path"]).parent, tmp_path / "kept")
    file = tmp_path / "kept" / "stream.modp"
    file.write_bytes(file.read_bytes()[: -lost or None])
    with opened(file) as again:
        assert not again.kept
        found = list(again)
    assert len(expected) == 4 and len(found) == len(expected) - (lost > 0)
    for one, other in zip(found, expected, strict=False):
        if isinstance(one, PoseCorrection):
            np.testing.assert_array_equal(one.T_camera_world, other.T_camera_world)
            continue
        assert (one.index, one.name, one.timestamp) == (other.index, other.name, other.timestamp)
        np.testing.assert_array_equal(one.rgba, other.rgba)
        np.testing.assert_array_equal(one.T_camera_world, other.T_camera_world)
        np.testing.assert_array_equal(one.points.xyz, other.points.xyz)


# ---- where it listens ----------------------------------------------------------------------------------------


def test_a_closed_server_leaves_nothing_behind(tmp_path: Path) -> None:
    with opened(tmp_path / "s") as tracker, greeted(tmp_path / "s") as connection:
        assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o600
        connection.sendall(message(FRAME, frame(1)))
        next(iter(tracker))
        kept = Path(tracker.kept["tracker"]["path"])
        assert kept.stat().st_size > 144
    assert not kept.parent.exists()
    assert list(tmp_path.iterdir()) == []
    assert not [thread for thread in threading.enumerate() if thread.name == "server"]


def test_an_address_is_of_this_machine_unless_another_is_asked_for() -> None:
    def notes(address: str) -> tuple[str, list[str]]:
        tracker = TrackerServer(SourceSettings(), SocketSettings(address=address))
        tracker.close()
        return tracker.address, tracker.notes

    assert notes("127.0.0.1:0")[1][1:] == []
    assert "is open to the network" in notes("0.0.0.0:0")[1][1]
    assert SocketSettings().address is None


def test_an_address_that_cannot_be_is_refused(tmp_path: Path) -> None:
    def failure(**tracker: object) -> str:
        with pytest.raises(InputError) as caught:
            TrackerServer(SourceSettings(), SocketSettings(**tracker))
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert "write it as host:port" in failure(address="7007")
    assert "write it as host:port" in failure(address="127.0.0.1:70070")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "cannot listen there" in failure(address=f"127.0.0.1:{taken.getsockname()[1]}")
    (tmp_path / "file").write_text("precious")
    assert "is there already and no socket" in failure(path=tmp_path / "file")
    assert (tmp_path / "file").read_text() == "precious"
    with opened(tmp_path / "s"):
        assert "another program listens there" in failure(path=tmp_path / "s")
    left = socket.socket(socket.AF_UNIX)
    left.bind(str(tmp_path / "left"))
    left.close()
    with opened(tmp_path / "left") as tracker, greeted(tmp_path / "left") as connection:
        connection.sendall(message(FRAME, frame(1)) + message(END))
        assert len(list(tracker)) == 1
