"""Videos: what any player expects of the file, and the pictures in it."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from modp_ti.files.errors import InputError
from modp_ti.outputs.playback.film import VIDEO_SUFFIXES, write_video

CODECS = {".mp4": "h264", ".webm": "vp9"}


@pytest.mark.parametrize("size", [(48, 64), (49, 65), (1, 1)])
@pytest.mark.parametrize("suffix", VIDEO_SUFFIXES)
def test_a_video_is_as_players_expect_and_keeps_the_colours(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], suffix: str, size: tuple[int, int]
) -> None:
    rng = np.random.default_rng(1)
    colours = rng.integers(30, 226, (12, 1, 1, 3), dtype=np.uint8)
    path = tmp_path / f"film{suffix}"
    write_video(path, np.tile(colours, (1, *size, 1)), 12.5)
    assert capfd.readouterr() == ("", "")
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt, float(stream.average_rate or 0)) == (CODECS[suffix], "yuv420p", 12.5)
        assert (context.height, context.width) == tuple(max(side // 2 * 2, 2) for side in size)
        # ITU-T H.273: 1 is BT.709; 1 is luma from 16 to 235.
        assert (context.colorspace, context.color_primaries, context.color_trc, context.color_range) == (1, 1, 1, 1)
        luma = np.stack([frame.to_ndarray()[: context.height] for frame in file.decode(stream)]).astype(np.float64)
    assert len(luma) == len(colours)
    exact = 16 + 219 * (colours[:, 0, 0] / 255.0 @ [0.2126, 0.7152, 0.0722])
    # One colour a picture: the codecs keep it to a level or so, and truncation would show in the mean.
    error = luma.mean(axis=(1, 2)) - exact
    assert np.abs(error).max() < 2
    assert abs(error.mean()) < 0.4
    if suffix == ".mp4":  # a browser needs the index before it can play
        content = path.read_bytes()
        assert content.index(b"moov") < content.index(b"mdat")


@pytest.mark.parametrize("suffix", VIDEO_SUFFIXES)
def test_a_video_that_fails_leaves_nothing(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(InputError, match="missing"):
        write_video(tmp_path / "missing" / f"film{suffix}", [np.zeros((8, 8, 3), np.uint8)], 10)

    def pictures():
        yield np.zeros((8, 8, 3), np.uint8)
        raise InputError("no more")

    with pytest.raises(InputError, match="no more"):
        write_video(tmp_path / f"film{suffix}", pictures(), 10)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", VIDEO_SUFFIXES)
def test_a_full_disk_is_said(tmp_path: Path, suffix: str) -> None:
    resource = pytest.importorskip("resource")
    noise = np.random.default_rng(0).integers(0, 256, (8, 48, 64, 3), dtype=np.uint8)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, limits[1]))  # larger files fail, as on a full disk
    try:
        with pytest.raises(InputError, match="cannot be written"):
            write_video(tmp_path / f"film{suffix}", noise, 10)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())
