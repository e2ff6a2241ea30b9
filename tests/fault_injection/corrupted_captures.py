"""Corruptions of captures, by kind and file."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from importlib.util import find_spec

from tests.captures import lzfse_stored
from tests.fault_injection.corruptions import (
    HUGE,
    Corruption,
    changed,
    in_json,
    png_file,
    replaced,
    rows_of,
    setting,
    whole,
    with_line,
)

__all__ = ["CAPTURES"]

NAN, INFINITY = float("nan"), float("inf")


def archive(files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return a zip archive."""
    with io.BytesIO() as stream:
        with zipfile.ZipFile(stream, "w", method) as written:
            for name, data in files.items():
                written.writestr(name, data)
        return stream.getvalue()


def in_archive(name: str, change: Callable[[bytes], bytes]) -> Corruption:
    """Replace a file in the archive by the result of `change`."""

    def content(data: bytes) -> bytes:
        with zipfile.ZipFile(io.BytesIO(data)) as packed:
            files = {each: packed.read(each) for each in packed.namelist()}
        files[name] = change(files[name])
        return archive(files)

    return changed(content)


def _claims(size: int) -> Corruption:
    """Let the first file's entry in the directory claim this unpacked size."""

    def content(data: bytes) -> bytes:
        at = data.index(b"PK\x01\x02") + 24
        return data[:at] + struct.pack("<I", size) + data[at + 4 :]

    return changed(content)


def _method(number: int) -> Corruption:
    def content(data: bytes) -> bytes:
        at = data.index(b"PK\x01\x02") + 10
        return data[:at] + struct.pack("<H", number) + data[at + 2 :]

    return changed(content)


def _numbers(path: str) -> dict[str, Corruption]:
    """Corruptions of a number in JSON."""
    return {
        "NaN": in_json(setting(path, NAN)),
        "infinity": in_json(setting(path, INFINITY)),
        "1e300": in_json(setting(path, 1e300)),
        "a word": in_json(setting(path, "one")),
        "true": in_json(setting(path, True)),
        "nothing": in_json(setting(path, None)),
        "a list": in_json(setting(path, [1, 2])),
    }


def _matrix(path: str, cells: int) -> dict[str, Corruption]:
    """Corruptions of a matrix in one list in JSON."""
    return {
        **{f"{name} in {path}": corrupt for name, corrupt in _numbers(f"{path}/1").items()},
        f"a number too few in {path}": in_json(setting(path, [1.0] * (cells - 1))),
        f"a number too many in {path}": in_json(setting(path, [1.0] * (cells + 1))),
        f"no {path}": in_json(setting(path, None)),
        f"zeros for {path}": in_json(setting(path, [0.0] * cells)),
    }


RECORD3D: dict[str, dict[str, Corruption]] = {
    "room.r3d": {
        "a bomb of bzip2": changed(lambda data: archive({"metadata": b" " * 60_000_000}, zipfile.ZIP_BZIP2)),
        "a bomb of LZMA": changed(lambda data: archive({"metadata": b" " * 60_000_000}, zipfile.ZIP_LZMA)),
        "a file without a name": changed(lambda data: archive({"xxxx": b"1"}).replace(b"xxxx", b"\0xxx")),
        "a bomb for the metadata": in_archive("metadata", lambda data: b" " * 60_000_000 + data),
        "metadata that are no JSON": in_archive("metadata", lambda data: data[:-20]),
        "no poses": in_archive("metadata", lambda data: data.replace(b'"poses"', b'"posts"')),
        "a pose of words": in_archive("metadata", lambda data: data.replace(b'"poses": [[', b'"poses": [["a", ')),
        "no picture": in_archive("metadata", lambda data: data.replace(b'"poses": [', b'"none": [')),
        "an unknown packing": _method(99),
        "a file that claims 4 GB": _claims(0xFFFFFFF0),
        "an archive of nothing": whole(archive({})),
        "an archive of something else": whole(archive({"a.txt": b"hello"})),
        "metadata alone": whole(archive({"metadata": b"{}"})),
    },
}

if find_spec("lzfse") is not None:  # without it depths are not read
    RECORD3D["room.r3d"] |= {
        "a depth of another size": in_archive("rgbd/1.depth", lambda data: lzfse_stored(bytes(100))),
        "a depth that is cut off": in_archive("rgbd/1.depth", lambda data: data[:40]),
        "a depth of noise": in_archive("rgbd/1.depth", lambda data: zlib.compress(data)),
        "a depth that claims 4 GB": in_archive("rgbd/1.depth", lambda data: b"bvx-\xff\xff\xff\xff" + data),
        "a packed block of noise": in_archive(
            "rgbd/1.depth", lambda data: struct.pack("<4sII", b"bvxn", 12288, 60) + bytes(range(60)) + b"bvx$"
        ),
        "a confidence that is damaged": in_archive("rgbd/1.conf", lambda data: b"bvx$"),
    }

SCANNER_APP: dict[str, dict[str, Corruption]] = {
    "app/frame_00003.json": _matrix("cameraPoseARFrame", 16)
    | _matrix("intrinsics", 9)
    | {f"{name} for a time": corrupt for name, corrupt in _numbers("time").items()}
    | {
        "a list": whole("[]"),
        "nested 5000 deep": whole("[" * 5000),
        "5000 digits": replaced("0.0", HUGE),
        "shear": in_json(setting("cameraPoseARFrame/1", 0.5)),
        "a mirror": in_json(setting("cameraPoseARFrame/0", -1.0)),
    },
    "app/depth_00003.png": {
        "a picture of 60000x60000": whole(png_file(60_000, 60_000)),
        "colours": whole(png_file(64, 48, bytes(48 * (1 + 3 * 64)))),
        "text": whole("depth"),
    },
}

POLYCAM: dict[str, dict[str, Corruption]] = {
    "room/keyframes/cameras/1733333.json": {
        **{f"{name} for t_01": corrupt for name, corrupt in _numbers("t_01").items()},
        **{f"{name} for fx": corrupt for name, corrupt in _numbers("fx").items()},
        **{f"{name} for width": corrupt for name, corrupt in _numbers("width").items()},
        "a list": whole("[]"),
        "a size of 2.5": in_json(setting("width", 2.5)),
        "a negative size": in_json(setting("height", -36)),
        "another size": in_json(setting("width", 4800)),
        "a focal length of 0": in_json(setting("fy", 0)),
        "a mirror": in_json(setting("t_00", -1.0)),
        "nested 5000 deep": whole("[" * 5000),
    },
}

NERFCAPTURE: dict[str, dict[str, Corruption]] = {
    "room/transforms.json": {
        "a list": whole("[]"),
        "no frames": in_json(setting("frames", [])),
        "frames of text": in_json(setting("frames", ["a", "b"])),
        "a frame without a name": in_json(setting("frames/0/file_path", 7)),
        "a name twice": in_json(lambda data: data["frames"].append(data["frames"][0])),
        "names of nothing there": changed(lambda data: data.replace(b'"images/', b'"other/')),
        "a name of 5000 letters": in_json(lambda data: [f.update(file_path="a/" * 2500) for f in data["frames"]]),
        "a matrix of words": in_json(setting("frames/1/transform_matrix", [["a"] * 4] * 4)),
        "a matrix of 3 numbers": in_json(setting("frames/1/transform_matrix", [1, 2, 3])),
        "NaN in a matrix": in_json(setting("frames/1/transform_matrix/0/3", NAN)),
        "a huge number in a matrix": in_json(setting("frames/1/transform_matrix/0/3", 1e300)),
        "shear": in_json(setting("frames/1/transform_matrix/0/1", 0.5)),
        **{f"{name} for a time": corrupt for name, corrupt in _numbers("frames/1/timestamp").items()},
        **{f"{name} for fl_x": corrupt for name, corrupt in _numbers("frames/1/fl_x").items()},
        "a size of 1e300": in_json(setting("w", 1e300)),
        "another size": in_json(setting("w", 480)),
    },
}

POSE = "500.016667, 000001, 0.1, 0, 0, 0, 0, 0, 1, 1600, 1600, 960, 720, , "


def _stray(place: int, new: str) -> Corruption:
    words = POSE.split(", ")
    return with_line(2, ", ".join([*words[:place], new, *words[place + 1 :]]))


STRAY_SCANNER: dict[str, dict[str, Corruption]] = {
    "room/odometry.csv": {
        "no header": changed(lambda data: data.split(b"\n", 1)[1]),
        "a column that is missing": replaced("qw", "w"),
        "a header alone": changed(lambda data: data.split(b"\n", 1)[0] + b"\n"),
        "a row too short": with_line(2, "500.0, 000001, 0.1"),
        **{
            f"{name} for a position": _stray(2, new)
            for name, new in (("NaN", "nan"), ("1e300", "1e300"), ("a word", "x"))
        },
        **{
            f"{name} for a focal length": _stray(9, new)
            for name, new in (("NaN", "nan"), ("0", "0"), ("1e300", "1e300"))
        },
        "infinity for a time": _stray(0, "inf"),
        "5000 digits": _stray(3, HUGE),
        "a quaternion of length 0": _stray(8, "0"),
        "a quaternion of length 2": _stray(8, "2"),
        "a quaternion of 1e200": _stray(8, "1e200"),
        "an image": whole(png_file(8, 8)),
        "a NUL": _stray(3, "\0"),
    },
}

# Each mapping merges the one before nine times.
MERGED = "a0: &a0 {k: 1}\n" + "".join(f"a{n}: &a{n}\n  <<: [{', '.join(9 * [f'*a{n - 1}'])}]\n" for n in range(1, 30))
EUROC: dict[str, dict[str, Corruption]] = {
    "room/mav0/cam0/sensor.yaml": {
        "merge keys that multiply": changed(lambda data: data + MERGED.encode()),
        "no intrinsics": replaced("intrinsics:", "extrinsics:"),
        "intrinsics of words": replaced("intrinsics: [", "intrinsics: [a, "),
        "a focal length of 0": replaced("intrinsics: [40.0", "intrinsics: [0.0"),
        "another size": replaced("resolution: [48", "resolution: [480"),
        "a size of words": replaced("resolution: [48", "resolution: [wide"),
        "no mount": replaced("T_BS:", "T_XX:"),
        "a mount that is a list": replaced("T_BS:\n  cols: 4\n  rows: 4\n  data:", "T_BS:"),
        "a mount of 17": replaced("data: [", "data: [1.0, "),
        "NaN in the mount": replaced("data: [", "data: [.nan, "),
        "an unknown lens": replaced("radial-tangential", "omnidirectional"),
        "a lens of 5": replaced("coefficients: [", "coefficients: [1.0, "),
        "a lens of 1e200": replaced("coefficients: [0.0", "coefficients: [1.0e+200"),
        "a megabyte": changed(lambda data: data + b"# x\n" * 250_000),
        "nested 5000 deep": whole("[" * 5000),
        "text": whole("hello"),
    },
    "room/mav0/state_groundtruth_estimate0/data.csv": rows_of("1 2 3", 1, 1)
    | {
        "a row too short": with_line(1, "1403715273262142976,1,2,3"),
        "a quaternion of length 0": with_line(1, "1403715273264142976,0,0,0,0,0,0,0,0"),
        "a quaternion of 1e29": with_line(1, "1403715273264142976,0,0,0,1e29,0,0,0,0"),
        "a position of 1e20": with_line(1, "1403715273264142976,1e20,0,0,1,0,0,0,0"),
        "times of another day": whole("1,0,0,0,1,0,0,0\n"),
    },
    "room/mav0/cam0/data.csv": {
        "a word for a time": with_line(1, "now,1.png"),
        "a time of 5000 digits": with_line(1, f"{HUGE},1.png"),
        "a line without a name": with_line(1, "1403715273262142976"),
        "images that are missing": changed(lambda data: data.replace(b".png", b".bmp")),
        "names of 300 letters": whole(f"5,{'a' * 300}.png\n"),
        "a NUL in a name": whole("5,a\0b.png\n"),
    },
}


ROW = "1 0 0 0.1 0 1 0 0 0 0 1 0"
KITTI: dict[str, dict[str, Corruption]] = {
    "room/poses.txt": rows_of(ROW, 3, 1)
    | {
        "shear": with_line(1, "1 0.5 0 0.1 0 1 0 0 0 0 1 0"),
        "a mirror": with_line(1, "-1 0 0 0.1 0 1 0 0 0 0 1 0"),
        "zeros for a matrix": with_line(1, "0 " * 12),
        "a position of 1e20": with_line(1, "1 0 0 1e20 0 1 0 0 0 0 1 0"),
    },
    "room/calib.txt": {
        "no P2": replaced("P2", "P9"),
        "a word": replaced("P2: ", "P2: a "),
        "a number too few": with_line(1, "P2: 1 2 3"),
        "zeros": with_line(1, "P2: " + "0 " * 12),
        "NaN": with_line(1, "P2: nan " + "0 " * 11),
        "a negative focal length": with_line(1, "P2: -40 0 24 0 0 40 18 0 0 0 1 0"),
        "1e300": with_line(1, "P2: 1e300 0 24 0 0 40 18 0 0 0 1 0"),
        "5000 digits": with_line(1, f"P2: {HUGE} 0 24 0 0 40 18 0 0 0 1 0"),
    },
    "room/times.txt": {"a word": with_line(1, "now"), "NaN": with_line(1, "nan"), "1e300": with_line(1, "1e300")},
}

SCANNET: dict[str, dict[str, Corruption]] = {
    "room/pose/1.txt": {
        "a row too few": whole("1 0 0 0\n0 1 0 0\n0 0 1 0\n"),
        "a row too many": changed(lambda data: data + b"0 0 0 1\n"),
        "a column too few": with_line(0, "1 0 0"),
        "a word": with_line(0, "1 0 0 one"),
        "shear": with_line(0, "1 0.5 0 0.1"),
        "1e300": with_line(0, "1 0 0 1e300"),
    },
    "room/intrinsic/intrinsic_color.txt": {
        "a row too few": whole("40 0 24\n0 40 18\n"),
        "NaN": with_line(0, "nan 0 24 0"),
        "a word": with_line(0, "f 0 24 0"),
        "a negative focal length": with_line(0, "-40 0 24 0"),
        "1e300": with_line(0, "1e20 0 24 0"),
    },
    "room/intrinsic/intrinsic_depth.txt": {
        "NaN": with_line(0, "nan 0 24 0"),
        "zeros": with_line(0, "0 0 0 0"),
        "a column too few": with_line(0, "1 0"),
    },
    "room/depth/1.png": {"text": whole("depth"), "colours": whole(png_file(64, 48, bytes(48 * (1 + 3 * 64))))},
}

TRAJECTORY = "3000.104 0 0 0 -0.1 0 0"
ARKITSCENES: dict[str, dict[str, Corruption]] = {
    "room/lowres_wide.traj": rows_of(TRAJECTORY, 4, 1)
    | {
        "a rotation of 1e10": with_line(1, "3000.104 1e10 0 0 -0.1 0 0"),
        "a position of 1e20": with_line(1, "3000.104 0 0 0 1e20 0 0"),
        "times of another day": whole("5 0 0 0 0 0 0\n"),
    },
    "room/lowres_wide_intrinsics/42_3000.101.pincam": {
        "a number too few": whole("48 36 40 40 24\n"),
        "a word": whole("48 36 40 40 24 middle\n"),
        "NaN": whole("48 36 nan 40 24 18\n"),
        "a focal length of 0": whole("48 36 0 40 24 18\n"),
        "another size": whole("480 360 40 40 24 18\n"),
        "a size of 1e20": whole("1e20 36 40 40 24 18\n"),
        "a size of 2.5": whole("2.5 36 40 40 24 18\n"),
    },
}

CAPTURES: dict[str, dict[str, dict[str, Corruption]]] = {
    "record3d": RECORD3D,
    "scanner_app": SCANNER_APP,
    "stray_scanner": STRAY_SCANNER,
    "polycam": POLYCAM,
    "nerfcapture": NERFCAPTURE,
    "euroc": EUROC,
    "kitti": KITTI,
    "scannet": SCANNET,
    "arkitscenes": ARKITSCENES,
}
