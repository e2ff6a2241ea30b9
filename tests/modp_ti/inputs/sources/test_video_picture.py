"""Videos as phones and camcorders write them: HDR, 10 bits, turned, mirrored, of varying frame rate."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from modp_ti.inputs.sources import VideoFile
from modp_ti.inputs.sources.tone_mapping import ToneMapping, Transfer

WIDTH, HEIGHT, FRAMES = 64, 48, 6
BT2020, LIMITED = 9, 1
KR, KB = 0.2627, 0.0593


def write(file: Path, codec: str, frames: list[av.VideoFrame], prepare=lambda stream: None, **properties) -> Path:
    """Properties: of the codec's context; `prepare` is called with the stream before the first frame."""
    with av.open(str(file), "w") as output:
        stream = output.add_stream(codec, rate=25)
        properties = {"width": WIDTH, "height": HEIGHT, "pix_fmt": frames[0].format.name, **properties}
        for name, value in properties.items():
            setattr(stream.codec_context, name, value)
        prepare(stream)
        for frame in (*frames, None):
            output.mux(stream.encode(frame))
    return file


def ycbcr(signal: np.ndarray) -> av.VideoFrame:
    """R'G'B' (H, W, 3) in [0, 1] as 10 bits of limited range with BT.2020's matrix, as H.273 has it."""
    luma = KR * signal[..., 0] + (1 - KR - KB) * signal[..., 1] + KB * signal[..., 2]
    blue, red = ((signal[..., at] - luma) / (2 * (1 - k)) for at, k in ((2, KB), (0, KR)))
    return ten_bits(64 + 876 * luma, 512 + 896 * blue, 512 + 896 * red)


def ten_bits(*planes: np.ndarray) -> av.VideoFrame:
    frame = av.VideoFrame(WIDTH, HEIGHT, "yuv444p10le")
    for plane, values in zip(frame.planes, planes, strict=True):
        rows = np.zeros((HEIGHT, plane.line_size // 2), "<u2")
        rows[:, :WIDTH] = np.round(values)
        plane.update(rows.tobytes())
    return frame


def test_hdr_is_tone_mapped_and_said(tmp_path):
    """The mapping itself is compared with the standards' formulas in `test_tone_mapping.py`."""
    down, right = np.mgrid[0 : 1 : HEIGHT * 1j, 0 : 1 : WIDTH * 1j]
    grey = 0.2 + 0.7 * right
    # Within BT.709's colours: at their boundary, a dark code jumps with the last bit of the signal.
    signal = np.stack([grey, grey - 0.04 * down, grey - 0.08 * right], axis=2)
    for transfer in Transfer:
        tags = {"color_trc": transfer.value, "color_primaries": BT2020, "colorspace": BT2020, "color_range": LIMITED}
        file = write(tmp_path / f"{transfer.name}.mkv", "ffv1", [ycbcr(signal) for _ in range(FRAMES)], **tags)
        video = VideoFile(file)
        expected = ToneMapping(transfer)(np.round(65535 * signal).astype(np.uint16))
        error = np.abs(video.read(video.names[3]).astype(int) - expected)
        # A code of 10 bits is up to two of 8 here.
        assert error.max() <= 3 and error.mean() < 0.6
        assert np.array_equal(video.read(video.names[0]), video.read(video.names[3]))
        (note,) = video.notes
        assert transfer.name in note


def test_ordinary_video_of_10_bits_keeps_all_8_and_their_mean(tmp_path):
    luma = np.linspace(64, 940, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
    video = VideoFile(write(tmp_path / "a.mkv", "ffv1", [ten_bits(luma, 512 + 0 * luma, 512 + 0 * luma)]))
    image = video.read(video.names[0]).astype(int)
    error = image - 255 * (np.round(luma)[..., None] - 64) / 876
    assert np.abs(error).max() <= 1.0 and abs(error.mean()) < 0.1
    assert len(np.unique(image[..., 1])) == 256
    assert video.notes == []


def pictures() -> list[av.VideoFrame]:
    shades = np.random.default_rng(2).integers(0, 255, (FRAMES, 3, 4, 3), dtype=np.uint8)
    return [
        av.VideoFrame.from_ndarray(np.kron(each, np.ones((HEIGHT // 3, WIDTH // 4, 1), np.uint8)), format="rgb24")
        for each in shades
    ]


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_frames_are_turned_and_mirrored_as_the_file_asks(tmp_path, degrees, mirrored):
    """`degrees` counts counter-clockwise, and the mirror comes last, as PyAV has it."""
    # Without loss: what the encoder leaves out differs between two runs on a machine that has other work.
    lossless = {"pix_fmt": "yuv420p", "options": {"qp": "0"}}
    plain = write(tmp_path / "plain.mp4", "libx264", pictures(), **lossless)
    asking = write(
        tmp_path / "asking.mp4",
        "libx264",
        pictures(),
        lambda stream: stream.set_display_rotation(degrees, hflip=mirrored),
        **lossless,
    )
    stored, video = VideoFile(plain), VideoFile(asking)
    expected = np.rot90(stored.read("plain_000002"), degrees // 90)
    expected = expected[:, ::-1] if mirrored else expected
    assert np.array_equal(video.read("asking_000002"), expected)
    assert video.size("asking_000002") == expected.shape[1::-1]
    assert len(video.notes) == (degrees != 0 or mirrored)


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_frames_of_varying_rate_have_their_own_times(tmp_path, suffix):
    times = np.array([0, 33, 70, 200, 210, 500])  # [ms]
    frames = pictures()
    for frame, time in zip(frames, times, strict=True):
        frame.pts, frame.time_base = int(time), Fraction(1, 1000)

    def in_milliseconds(stream) -> None:
        stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)

    file = write(tmp_path / f"a.{suffix}", "libx264", frames, in_milliseconds, pix_fmt="yuv420p")
    video = VideoFile(file, fps=1.0)
    np.testing.assert_allclose([video.timestamp(name) for name in video.names], times / 1000.0, atol=1e-3)
    forwards = [video.read(name) for name in video.names]
    for name, image in reversed(list(zip(video.names, forwards, strict=True))):
        assert np.array_equal(video.read(name), image)
