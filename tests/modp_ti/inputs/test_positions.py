"""GPS positions: of files beside a recording, of photographs, bags and a GoPro's video."""

from __future__ import annotations

import struct
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from modp_ti.files.errors import InputError
from modp_ti.inputs.positions import read_positions, recorded_gravity, recorded_positions
from tests.samples.bags import Messages, write_bag

PLACES = np.array([[47.5, -8.25, 431.5], [-0.125, 8.5, -3.0]])
TIMES = [1_700_000_000.0, 1_700_000_002.5]


def test_gpx_and_csv_say_the_same(tmp_path: Path) -> None:
    gpx, timed, named = tmp_path / "a.gpx", tmp_path / "b.csv", tmp_path / "c.csv"
    points = "".join(
        f'<trkpt lat="{lat}" lon="{lon}"><ele>{height}</ele><time>2023-11-14T22:13:{second}Z</time></trkpt>'
        for (lat, lon, height), second in zip(PLACES, ("20", "22.500"), strict=True)
    )
    gpx.write_text(f'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{points}</trkseg></trk></gpx>')
    rows = [",".join(map(str, row)) for row in PLACES]
    timed.write_text("time,Latitude,lon,altitude\n" + "".join(f"{t},{r}\n" for t, r in zip(TIMES, rows, strict=True)))
    named.write_text("image,lat,lon,height\n" + "".join(f"{k}.jpg,{row}\n" for k, row in enumerate(rows)))
    for file in (gpx, timed):
        found = read_positions(file, tmp_path, 1.5)
        np.testing.assert_allclose(found.geodetic, PLACES)
        np.testing.assert_allclose(found.times, np.array(TIMES) + 1.5)
    found = read_positions(named, tmp_path)
    np.testing.assert_allclose(found.geodetic, PLACES)
    assert found.names == ["0.jpg", "1.jpg"]


@pytest.mark.parametrize("text", ["", "time,lat\n1,2\n", "time,lat,lon,height\n1,2,x,4\n", "<gpx", "<gpx></gpx>"])
def test_a_file_without_positions_is_refused(tmp_path: Path, text: str) -> None:
    for file in (tmp_path / "a.csv", tmp_path / "a.gpx"):
        file.write_text(text)
        with pytest.raises(InputError):
            read_positions(file, tmp_path)


def test_photographs_have_their_places(tmp_path: Path) -> None:
    for k, (lat, lon, height) in enumerate(PLACES):
        exif = Image.Exif()
        angles = [(int(abs(a)), int(abs(a) * 60 % 60), abs(a) * 3600 % 60) for a in (lat, lon)]
        sides = "S" if lat < 0 else "N", "W" if lon < 0 else "E", b"\1" if height < 0 else b"\0"
        tags = {1: sides[0], 2: angles[0], 3: sides[1], 4: angles[1], 5: sides[2], 6: abs(height)}
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(tags)
        Image.new("RGB", (8, 8)).save(tmp_path / f"{k}.jpg", exif=exif)
    Image.new("RGB", (8, 8)).save(tmp_path / "none.jpg")
    found = recorded_positions(tmp_path, ["0.jpg", "none.jpg", "1.jpg", "gone.jpg"])
    np.testing.assert_allclose(found.geodetic, PLACES, atol=1e-6)
    assert found.names == ["0.jpg", "1.jpg"]
    with pytest.raises(InputError):
        recorded_positions(tmp_path, ["none.jpg"])


def test_a_bag_has_the_fixes_of_its_receiver(tmp_path: Path) -> None:
    make = Messages()
    messages = []
    for time, place, status in zip((0, 1, 2), (*PLACES, PLACES[0]), (0, 2, -1), strict=True):
        stamp = int(TIMES[0]) * 10**9 + time * 10**9
        header, state = make.header(stamp, "gps"), make.make("sensor_msgs/NavSatStatus", status, 1)
        fix = make.make("sensor_msgs/NavSatFix", header, state, *place.tolist(), np.zeros(9), 0)
        messages.append(("/gps/fix", stamp + 7, fix))
    found = recorded_positions(write_bag(tmp_path / "walk", "mcap", messages), [])
    np.testing.assert_allclose(found.geodetic, PLACES)
    np.testing.assert_allclose(found.times, [TIMES[0], TIMES[0] + 1.0])


def record(key: str, kind: str, size: int, content: bytes) -> bytes:
    """A record of GPMF; kind "" for one that holds others."""
    head = struct.pack(">4sBBH", key.encode(), ord(kind or "\0"), size, len(content) // size)
    return head + content + bytes(-len(content) % 4)


def write_track(video: Path, packets: list[bytes]) -> None:
    """A video file with a track of telemetry, in packets of 0.9 s."""
    with av.open(str(video), "w") as container:
        track = container.add_data_stream("bin_data")
        for number, data in enumerate(packets):
            packet = av.Packet(data)
            packet.stream, packet.time_base, packet.duration = track, Fraction(1, 1000), 900
            packet.pts = packet.dts = 900 * number
            container.mux(packet)


def test_fixes_of_a_video_are_those_with_two_dimensions_or_more(tmp_path: Path) -> None:
    columns, scale = "lllllllSS", (10**7, 10**7, 1000, 1000, 100, 1, 1000, 100, 1)
    rows = [(*(np.array(place) * scale[:3]).round().astype(int), 0, 0, 1, 2, 3, 3) for place in PLACES]
    rows.insert(1, (0,) * 9)
    stream = record("SCAL", "l", 4, struct.pack(">9l", *scale)) + record("TYPE", "c", 1, columns.encode())
    stream += record("GPS9", "?", 32, b"".join(struct.pack(">7l2H", *row) for row in rows))
    packet = record("DEVC", "", 1, record("DVNM", "c", 1, b"camera") + record("STRM", "", 1, stream))
    write_track(tmp_path / "whole.mp4", [packet, packet])
    write_track(tmp_path / "cut.mp4", [packet[:-90]])
    found = recorded_positions(tmp_path / "whole.mp4", [])
    np.testing.assert_allclose(found.geodetic, np.tile(PLACES, (2, 1)), atol=1e-6)
    np.testing.assert_allclose(found.times, [0.0, 0.6, 0.9, 1.5], atol=1e-3)
    with pytest.raises(InputError):
        recorded_positions(tmp_path / "cut.mp4", [])


def test_gravity_of_a_video_is_that_of_its_stabilised_pictures(tmp_path: Path) -> None:
    rolls, times = np.radians([20.0, -10.0, 0.0]), np.array([0.0, 0.3, 0.6])
    down = np.stack([np.sin(rolls), np.cos(rolls), 0.0 * rolls], axis=1)  # of a camera that rolls
    turns = Rotation.from_rotvec(rolls[:, None] * [0.0, 0.0, 1.0])  # and whose pictures are turned back
    scale = record("SCAL", "s", 2, struct.pack(">h", 32767))
    gravity, turn = (
        scale + record(key, "s", 2 * values.shape[1], (32767 * values).round().astype(">i2").tobytes())
        for key, values in (("GRAV", down), ("IORI", turns.as_quat()[:, [3, 0, 1, 2]]))
    )
    for streams, expected in (([gravity], down), ([gravity, turn], np.tile([0.0, 1.0, 0.0], (3, 1)))):
        packet = record("DEVC", "", 1, b"".join(record("STRM", "", 1, stream) for stream in streams))
        write_track(tmp_path / "a.mp4", [packet])
        found = recorded_gravity(tmp_path / "a.mp4", times)
        assert found is not None
        np.testing.assert_allclose(found, expected, atol=1e-3)
        assert recorded_gravity(tmp_path / "a.mp4", times + 5.0) is None


def test_the_videos_of_a_camera_and_a_drone_have_their_ways(shared_data: Callable[[str], Path]) -> None:
    for video, speed, duration in (("gopro_walk.mp4", 1.25, 10.5), ("karma.mp4", 6.9, 12.1)):
        found = recorded_positions(shared_data("clips") / video, [])
        assert found.times is not None and 0.0 <= found.times[0] < 1.0
        np.testing.assert_allclose(found.times[-1], duration, atol=1.0)
        north, east = np.radians(np.diff(found.geodetic[:, :2], axis=0)).T * 6.37e6
        length = np.hypot(north, east * np.cos(np.radians(found.geodetic[0, 0]))).sum()
        assert length / np.ptp(found.times) == pytest.approx(speed, rel=0.15)
