"""The tracker in a process of its own delivers what it delivers in this one, waits for nobody, and may die."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.inputs.klt import open_klt
from modp_ti.inputs.opening import open_source, open_tracker
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.inputs.sources import FrameReader
from modp_ti.inputs.sources.live import list_frames
from modp_ti.inputs.tracking_process import TrackingProcess
from tests.modp_ti.inputs.mjpeg_camera import MjpegCamera, encoded
from tests.patience import PATIENCE

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("interruptible")]


@pytest.fixture(scope="module")
def folder(box_walk, tmp_path_factory) -> Path:
    return box_walk.written(tmp_path_factory.mktemp("walk") / "images")


@pytest.fixture
def scene(box_room, folder):
    """Settings of the walk; the camera is known."""

    def make(**source) -> SceneConfig:
        c = box_room.camera
        intrinsics = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy}
        where = {} if "stream" in source else {"path": folder}
        settings = {**where, "intrinsics": intrinsics, "scale": 0.5, "holdout": 8, **source}
        return SceneConfig.model_validate({"source": settings, "tracker": {"kind": "klt"}, "output": "out"})

    return make


@pytest.fixture
def started():
    """Opens a process, and closes it at the end of the test."""
    made: list[TrackingProcess] = []

    def make(config: SceneConfig) -> TrackingProcess:
        made.append(TrackingProcess(config))
        return made[-1]

    yield make
    for tracker in made:
        tracker.close()
        tracker.close()  # a second time is no fault


def assert_same(one: TrackedFrame, other: TrackedFrame) -> None:
    """Every byte of two frames is the same, except for the time of arrival."""
    for name in ("index", "timestamp", "name", "camera", "held_out"):
        assert getattr(one, name) == getattr(other, name), name
    for name in ("image", "T_camera_world", "rgba", "mask", "vignette"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    for name in ("xyz", "pixels", "ids"):
        np.testing.assert_array_equal(getattr(one.points, name), getattr(other.points, name), name)
    for a, b in zip(one.pyramid, other.pyramid, strict=True):
        assert a.camera == b.camera
        np.testing.assert_array_equal(a.rgba, b.rgba)


def wait_until(condition) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


@pytest.mark.parametrize("masked", [False, True])
def test_it_delivers_what_the_tracker_delivers_in_this_process(scene, started, tmp_path, box_walk, masked):
    # Dark parts of the images are masked, and the lens darkens one side.
    light = np.tile(np.linspace(100, 255, 320).astype(np.uint8), (240, 1))
    (tmp_path / "light.png").write_bytes(cv2.imencode(".png", light)[1].tobytes())
    darkened = {"masks": box_walk.written(tmp_path / "masks"), "vignette": tmp_path / "light.png"}
    config = scene(**darkened) if masked else scene()
    here, there = open_klt(config.source, seed=config.seed), started(config)
    expected, got = list(here), list(there)
    assert masked or sum(isinstance(event, PoseCorrection) for event in expected) > 0
    for one, other in zip(got, expected, strict=True):
        if isinstance(one, TrackedFrame):
            assert isinstance(other, TrackedFrame)
            assert_same(one, other)
            continue
        for name in ("index", "T_camera_world", "ids", "xyz"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    assert (there.scale, there.frame_count) == (here.scale, here.frame_count)
    assert there.live is None and "the tracker has a process of its own with one core" in there.notes[-1]
    there._process.wait(PATIENCE)  # what comes now does not need it
    names = [event.name for event in expected if isinstance(event, TrackedFrame)]
    for (name, one), (same, other) in zip(there.pictures(names), here.pictures(names), strict=True):
        assert name == same and one.camera == other.camera
        np.testing.assert_array_equal(one.image, other.image)
    assert list(there) == []


def test_a_mapper_that_takes_nothing_does_not_hold_up_the_tracker(scene, started):
    config = scene(realtime=True, fps=20)
    tracker = open_tracker(config)
    assert isinstance(tracker, TrackingProcess)
    began = time.monotonic()
    wait_until(lambda: tracker.live.arrived == 60 and tracker.live.waiting + tracker.live.thinned == 60)
    assert time.monotonic() - began > 1.5, "at the pace of the images"
    frames = [event for event in tracker if isinstance(event, TrackedFrame)]
    counts = tracker.live
    assert (counts.waiting, counts.tracked, counts.lost) == (0, len(frames), 0)
    arrived = [frame.arrived for frame in frames]
    assert arrived == sorted(arrived) and began - PATIENCE < arrived[0] and counts.newest >= arrived[-1]
    reader = FrameReader(open_source(config.without_clock().source), config.source)
    undistorter = reader.images.intrinsics.undistorter(0.5)
    for frame in frames:
        np.testing.assert_array_equal(frame.image, reader.read(frame.name, undistorter).image)
    tracker.close()


def test_a_process_that_is_killed_ends_the_recording_with_a_note(scene, started):
    tracker = started(scene(realtime=True, fps=20))
    events = iter(tracker)
    frames = [event for event in (next(events) for _ in range(5)) if isinstance(event, TrackedFrame)]
    os.kill(tracker._process.pid, signal.SIGKILL)
    frames += [event for event in events if isinstance(event, TrackedFrame)]
    said = f"the tracker process ended (signal 9); the map is finished with the {len(frames)} frames before"
    assert tracker.notes[-1] == said
    names = [frame.name for frame in frames]
    assert [name for name, _ in tracker.pictures(names)] == names


def test_a_process_that_is_killed_before_its_first_frame_is_an_error(scene, started):
    tracker = started(scene(realtime=True, fps=0.01))  # the second image does not come
    assert tracker.scale == 0.5  # it is open
    os.kill(tracker._process.pid, signal.SIGKILL)
    with pytest.raises(InputError, match=r"^the tracker process ended \(signal 9\) before it delivered a frame$"):
        list(tracker)


def test_ctrl_c_ends_the_recording_and_a_second_one_interrupts(scene, started):
    tracker = started(scene(realtime=True, fps=20))
    events = iter(tracker)
    taken = [next(events) for _ in range(3)]
    os.kill(tracker._process.pid, signal.SIGINT)  # as from the terminal, to the whole group
    os.kill(os.getpid(), signal.SIGINT)
    taken += events
    assert tracker._process.wait(PATIENCE) == 0
    assert 3 <= len(taken) and tracker.live.arrived < 60
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(PATIENCE)


def test_ctrl_c_after_the_end_of_the_stream_goes_to_the_run_though_frames_wait(scene, started):
    pressed = []
    before = signal.signal(signal.SIGINT, lambda *_: pressed.append(True))
    try:
        tracker = started(scene(realtime=True, fps=20))
        events = iter(tracker)
        taken = [next(events)]
        wait_until(lambda: tracker.live.arrived == 60 and not tracker._board.recording)
        os.kill(os.getpid(), signal.SIGINT)
        wait_until(lambda: pressed)
        taken += events
        frames = [event for event in taken if isinstance(event, TrackedFrame)]
        assert len(frames) == tracker.live.tracked > 10, "the frames that wait are still there"
    finally:
        signal.signal(signal.SIGINT, before)


def test_input_errors_are_those_of_the_tracker(scene, started, tmp_path, folder):
    with pytest.raises(InputError, match="no such folder of images"):
        list(started(scene(path=tmp_path / "nothing")))
    dark = tmp_path / "dark"
    dark.mkdir()
    for i in range(3):
        (dark / f"{i}.png").write_bytes(encoded(np.zeros((120, 160, 3), np.uint8)))
    tracker = started(scene(path=dark, intrinsics={"fx": 100.0}))
    with pytest.raises(InputError, match="klt could place none of the 3 images"):
        list(tracker)


@pytest.fixture
def camera():
    made = MjpegCamera()
    yield made
    made.shut_down()


def test_a_stream_that_stalls_goes_on_and_its_frames_can_be_read_again(scene, started, camera, box_walk):
    pictures = [encoded(image[..., ::-1]) for image in box_walk.images]
    go_on = threading.Event()

    def film() -> None:
        for i, picture in enumerate(pictures):
            if i == 30:
                go_on.wait(PATIENCE)
            camera.send_jpeg(picture)
            time.sleep(0.15)  # a tracker that gets a third of a core still finds neighbouring frames
        camera.end()

    threading.Thread(target=film, daemon=True).start()
    tracker = started(scene(stream=camera.url))
    kept = Path(tracker._kept.name)
    events = iter(tracker)
    frames = [next(events) for _ in range(5)]
    wait_until(lambda: tracker.live.arrived == 30)
    time.sleep(0.5)
    newest = tracker.live.newest
    go_on.set()
    frames = [event for event in [*frames, *events] if isinstance(event, TrackedFrame)]
    assert tracker.live.newest > newest + 0.4
    assert tracker.live.tracked == len(frames) > 10
    assert tracker.live.tracked + tracker.live.thinned + tracker.live.lost == tracker.live.arrived == 60
    tracker._process.wait(PATIENCE)
    for (_, one), other in zip(tracker.pictures([frame.name for frame in frames]), frames, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
    tracker.close()
    assert not kept.exists()


def test_what_was_recorded_stays_when_the_parent_is_killed(camera, box_walk, tmp_path):
    camera.send_jpeg(*[encoded(image[..., ::-1]) for image in box_walk.images])
    code = (
        "import sys; from modp_ti.config.settings import SceneConfig; "
        "from modp_ti.inputs.tracking_process import TrackingProcess\n"
        "source = {'stream': sys.argv[1], 'intrinsics': {'fx': 270.0}}\n"
        "tracker = TrackingProcess(SceneConfig(source=source, tracker={'kind': 'klt'}, output='out'))\n"
        "next(iter(tracker))\n"
        "print(tracker._process.pid, flush=True)\n"
        "input()\n"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", code, camera.url]
    pipe = subprocess.PIPE
    parent = subprocess.Popen(command, env=environment, text=True, stdin=pipe, stdout=pipe)
    child = int(parent.stdout.readline())
    assert len(list(tmp_path.iterdir())) == 1
    parent.kill()
    parent.wait()
    wait_until(lambda: not Path(f"/proc/{child}").exists() or "Z" in Path(f"/proc/{child}/stat").read_text().split()[2])
    parent.stdin.close()
    parent.stdout.close()
    (folder,) = tmp_path.iterdir()
    list_frames(folder)
    images = open_source(SourceSettings(path=folder))
    assert len(images.names) > 2
    assert list(map(images.timestamp, images.names)) == sorted(map(images.timestamp, images.names))
    sent = encoded(box_walk.images[0][..., ::-1])
    expected = cv2.imdecode(np.frombuffer(sent, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    found = images.read(images.names[0])
    assert np.corrcoef(found.ravel(), expected.ravel())[0, 1] > 0.95  # two decoders of JPEG
