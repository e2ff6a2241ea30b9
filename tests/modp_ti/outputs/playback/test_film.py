"""Videos: what any player expects of the file, and the pictures in it."""

from __future__ import annotations

import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from fields.geometry.se3 import inverse_se3
from modp_ti.files.errors import InputError
from modp_ti.outputs.playback.film import VIDEO_SUFFIXES, Encoding, normals, write_pictures, write_video
from tests.room import Room, pinhole, walk

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


# ---- depth and normals -------------------------------------------------------------------------------------------


def test_normals_are_those_of_the_room(room: Room) -> None:
    camera, T = pinhole(160, 120), walk(3)[1]
    v, u = np.mgrid[:120, :160] + 0.5
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = camera.unproject(pixels, np.ones(len(pixels)))
    t, _, true = room.cast(inverse_se3(T)[:3, 3], rays @ T[:3, :3])
    true = true @ T[:3, :3].T
    true *= -np.sign((true * rays).sum(axis=1, keepdims=True))  # towards the camera
    found = normals(rays.reshape(120, 160, 3), t.reshape(120, 160)).reshape(-1, 3)
    known = found.any(axis=1)
    assert known.mean() > 0.98
    np.testing.assert_allclose(np.linalg.norm(found[known], axis=1), 1.0)
    assert ((found * rays).sum(axis=1)[known] < 0).all()
    angle = np.degrees(np.arccos(np.clip((found * true).sum(axis=1)[known], -1, 1)))
    assert np.median(angle) < 0.1 and (angle < 5).mean() > 0.93  # but for where two surfaces meet
    holed = t.reshape(120, 160).copy()
    holed[50:60, 70:80] = 0.0
    assert not normals(rays.reshape(120, 160, 3), holed)[50:60, 70:80].any()


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("encoding", ["tiff", "exr", "png"])
def test_another_program_reads_depth_and_normals(tmp_path: Path, encoding: Encoding, channels: int) -> None:
    rng, unit = np.random.default_rng(7), 0.001
    values = rng.normal(size=(24, 36, 3))
    values /= np.linalg.norm(values, axis=2, keepdims=True)
    values = 9.0 * np.abs(values[..., 0]) if channels == 1 else values
    values[3:6] = 0.0  # unknown
    write_pictures(tmp_path / "new", [values, values[::-1]], encoding, unit)
    names = sorted(path.name for path in (tmp_path / "new").iterdir() if path.suffix != ".json")
    assert names == [f"000000.{encoding}", f"000001.{encoding}"]
    for name, true in zip(names, (values, values[::-1]), strict=True):
        if encoding == "exr":
            with av.open(str(tmp_path / "new" / name)) as file:
                (frame,) = file.decode(video=0)
            read = frame.to_ndarray().reshape(true.shape)
        else:
            read = cv2.imread(str(tmp_path / "new" / name), cv2.IMREAD_UNCHANGED)
            read = read if channels == 1 else read[..., ::-1]
        assert read.dtype == (np.uint16 if encoding == "png" else np.float32)
        bound = 1e-6
        if encoding == "png":
            known = true.reshape(24, 36, -1).any(axis=2)
            assert (read[known] > 0).all() and not read[~known].any()
            read = np.where(read > 0, unit * read if channels == 1 else (read - 32768.0) / 32767.0, 0.0)
            bound = 0.51 * (unit if channels == 1 else 1 / 32767)
        np.testing.assert_allclose(read, true, atol=bound)
    if encoding == "png" and channels == 1:
        assert json.loads((tmp_path / "new" / "unit.json").read_text()) == {"scene_units": unit}
