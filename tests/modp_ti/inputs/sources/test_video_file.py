"""A video's frames are those of the file in any order, with the container's times; bad files get one line.

Oracles: what was written (a lossless codec), OpenCV's reading from the first frame to the last, to the bit, and MP4
files whose bytes are changed by hand.
"""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.stream import Disposition

from modp_ti.config.bare_recording import is_recording
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.inputs.sources import VideoFile

FRAMES, FPS = 40, 12.5
# The same pictures under `--spread` too: what an encoder makes of them, and whether AVI then tells times, follows them.
RNG = np.random.Generator(np.random.PCG64(5))
PATTERNS = [RNG.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in range(FRAMES)]
IMAGES = [np.asarray(cv2.GaussianBlur(pattern, (0, 0), 2), np.uint8) for pattern in PATTERNS]
# Inter-coded with a keyframe every twelve frames, each frame on its own, and lossless.
CODECS = {"room.mp4": "mp4v", "room.avi": "MJPG", "room.mkv": "FFV1"}
# Written by FFmpeg: codec and pixels; with frames out of order, ten bits, grey, other colours, and a late first frame.
FORMS = {
    "film/room.mp4": ("libx264", {"pix_fmt": "yuv420p", "colorspace": 1, "color_range": 1}),
    "full/room.mp4": ("libx264", {"pix_fmt": "yuvj420p", "colorspace": 1, "color_range": 2}),
    "deep/room.mkv": ("libx264", {"pix_fmt": "yuv420p10le"}),
    "grey/room.mkv": ("ffv1", {"pix_fmt": "gray"}),
    "room.webm": ("libvpx-vp9", {"pix_fmt": "yuv420p"}),
    "room.ts": ("mpeg4", {"pix_fmt": "yuv420p"}),
}


def write(file: Path, codec: str, images=IMAGES) -> Path:
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*codec), FPS, (64, 48))
    assert writer.isOpened()
    for image in images:
        writer.write(image[..., ::-1])
    writer.release()
    return file


def by_ffmpeg(file: Path, codec: str, metadata: str = "", **properties) -> Path:
    """Properties: of the codec's context."""
    file.parent.mkdir(exist_ok=True)
    with av.open(str(file), "w") as output:
        output.metadata["title"] = metadata
        stream = output.add_stream(codec, rate=Fraction(FPS))
        for name, value in {"width": 64, "height": 48, "pix_fmt": "yuv420p", **properties}.items():
            setattr(stream.codec_context, name, value)
        for image in (*IMAGES, None):
            frame = None if image is None else av.VideoFrame.from_ndarray(image, format="rgb24")
            output.mux(stream.encode(frame))
    return file


@pytest.fixture(params=[*CODECS, *FORMS.items()], ids=[*CODECS, *("ffmpeg's " + name for name in FORMS)])
def video(tmp_path, request) -> Path:
    if isinstance(request.param, str):
        return write(tmp_path / request.param, CODECS[request.param])
    name, (codec, properties) = request.param
    return by_ffmpeg(tmp_path / name, codec, **properties)


@pytest.fixture
def mp4(tmp_path) -> Path:
    return write(tmp_path / "room.mp4", "mp4v")


def by_opencv(file: Path) -> list[np.ndarray]:
    capture, images = cv2.VideoCapture(str(file)), []
    while True:
        more, image = capture.read()
        if not more:
            return images
        images.append(image[..., ::-1])


def test_frames_are_named_counted_and_timed_by_the_container(video):
    made = VideoFile(video, fps=99.0)
    assert tuple(made.names[:2]) == ("room_000000", "room_000001")
    assert len(made) == FRAMES
    assert made.position("room_000012") == 12
    assert made.size("room_000003") == (64, 48)
    np.testing.assert_allclose([made.timestamp(n) for n in made.names], np.arange(FRAMES) / FPS, atol=1e-3)
    assert made.notes == [] and made.intrinsics is None


@pytest.mark.parametrize("thumbnail", [False, True])
def test_the_best_stream_is_taken_wherever_it_stands(tmp_path, thumbnail):
    """A small preview comes first; a thumbnail does not count as a stream."""
    file = tmp_path / "room.mp4"
    with av.open(str(file), "w") as output:
        streams = []
        for codec, (width, height) in (("mjpeg", (320, 240)), ("mpeg4", (32, 24)), ("mpeg4", (64, 48))):
            if codec == "mjpeg" and not thumbnail:
                continue
            stream = output.add_stream(codec, rate=Fraction(FPS))
            stream.width, stream.height, stream.pix_fmt = width, height, "yuvj420p" if codec == "mjpeg" else "yuv420p"
            stream.disposition = Disposition.attached_pic if codec == "mjpeg" else Disposition.default
            streams.append(stream)
        for number, image in enumerate(IMAGES[:5]):
            for stream in streams:
                if number == 0 or stream.codec_context.name != "mjpeg":
                    scaled = np.asarray(cv2.resize(image, (stream.width, stream.height)), np.uint8)
                    output.mux(stream.encode(av.VideoFrame.from_ndarray(scaled, format="rgb24")))
        for stream in streams:
            output.mux(stream.encode(None))
    made = VideoFile(file)
    assert (len(made), made.frame_size) == (5, (64, 48))
    assert len(made.notes) == 1


@pytest.mark.parametrize("name", ["room", "room.LRV", "room.clip"])
def test_a_video_is_known_by_its_content(mp4, name):
    named = mp4.rename(mp4.with_name(name))
    assert is_recording(named)
    assert open_source(SourceSettings(path=named)).frame_size == (64, 48)


@pytest.mark.parametrize(
    ("name", "content"), [("scene", b"source: {path: a}"), ("a.bin", bytes(99)), ("x.pdf", b"%PDF-1.4")]
)
def test_other_files_are_no_videos(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert not is_recording(tmp_path / name)


def test_every_order_of_reading_gives_the_frames_of_the_file(video):
    expected = by_opencv(video)
    backwards, shuffled = range(FRAMES - 1, -1, -1), RNG.permutation(FRAMES)
    for orders in ([range(FRAMES)] * 2, [range(0, FRAMES, 7), backwards], [shuffled, shuffled[::-1]]):
        made = VideoFile(video)
        for order in orders:
            for i in order:
                assert np.array_equal(made.read(made.names[int(i)]), expected[i]), (list(order), i)


def test_lossless_video_gives_the_very_pixels_that_were_written(tmp_path):
    made = VideoFile(write(tmp_path / "a.mkv", "FFV1"))
    difference = [np.abs(made.read(n).astype(int) - image).max() for n, image in zip(made.names, IMAGES, strict=True)]
    assert max(difference) == 0


@pytest.mark.parametrize("seed", [1])
def test_damaged_video_looks_the_same_whenever_it_is_read(mp4, seed):
    rng, data = np.random.default_rng(seed), bytearray(mp4.read_bytes())
    end = data.index(b"moov") - 4
    for place in rng.integers(500, end, 25):
        data[place] ^= 0xFF
    mp4.write_bytes(data)
    made, again = VideoFile(mp4), VideoFile(mp4)
    first = [made.read(name) for name in made.names]
    order = rng.permutation(len(made))
    assert all(np.array_equal(made.read(made.names[int(i)]), first[i]) for i in order)
    assert all(np.array_equal(again.read(again.names[int(i)]), first[i]) for i in order)
    assert len(made) > 20


def test_stop_ends_the_reading_there(mp4):
    made = VideoFile(mp4, stop=7)
    assert len(made) == 7
    assert made.selected(1, 7, 3) == ["room_000001", "room_000004"]
    with pytest.raises(InputError, match=r"source\.start"):
        made.selected(7, None, 1)


def test_stream_without_times_is_timed_by_the_setting(tmp_path):
    made = VideoFile(by_ffmpeg(tmp_path / "room.h264", "libx264"), fps=20.0)
    assert made.timestamp("room_000010") == 0.5
    assert len(made.notes) == 1


def test_a_frame_is_found_by_its_whole_name_alone(mp4):
    made = VideoFile(mp4)
    for asked in ("room_000003", "frames/room_000003.png", "frames\\room_000003.JPG"):
        assert made.find(asked) == "room_000003"
    assert not any(map(made.find, ("room_000040", "000003.png", "room.mp4", "")))


@pytest.mark.parametrize("part", [0.5, 0.9])
@pytest.mark.parametrize("codec", [c for c in CODECS if c != "room.mp4"])
def test_of_a_video_that_is_cut_off_the_frames_before_are_read(tmp_path, codec, part):
    file = write(tmp_path / codec, CODECS[codec])
    whole, data = by_opencv(file), file.read_bytes()
    file.write_bytes(data[: int(part * len(data))])
    made = VideoFile(file)
    assert 0.4 * part * FRAMES < len(made) < FRAMES
    for i, name in enumerate(list(made.names)[:-1]):
        assert np.array_equal(made.read(name), whole[i])


def test_files_that_are_no_videos_are_named(tmp_path):
    file = tmp_path / "a.mp4"
    for content in (b"", b"no video"):
        file.write_bytes(content)
        with pytest.raises(InputError, match=r"a\.mp4"):
            VideoFile(file)
    for place in (tmp_path / "gone.mp4", tmp_path):
        with pytest.raises(InputError, match=place.name):
            VideoFile(place)


def test_frames_beyond_the_largest_image_are_refused(tmp_path, monkeypatch):
    from modp_ti.inputs.sources import video_file

    files = [by_ffmpeg(tmp_path / name, "mpeg4") for name in ("room.mp4", "room.ts")]
    for limit, refused in ((64 * 48 - 1, True), (1 << 20, False)):  # codecs count what they put around an image
        monkeypatch.setattr(video_file, "LIMITS", {"max_pixels": str(limit)})
        for file in files:
            if refused:
                with pytest.raises(InputError, match=file.name):
                    VideoFile(file)
            else:
                assert len(VideoFile(file)) == FRAMES
