"""Corruptions of scene files and trackers' files."""

from __future__ import annotations

import gzip
import struct

import msgpack

from tests.fault_injection.corruptions import (
    HUGE,
    Corruption,
    appended,
    archive_npy,
    bomb,
    changed,
    in_gz,
    in_json,
    in_stella,
    key_of,
    laughs,
    npy_file,
    patched,
    pickled_npy,
    ply_file,
    png_file,
    replaced,
    rows_of,
    setting,
    whole,
    with_line,
)

__all__ = [
    "ARIA",
    "COLMAP",
    "COLMAP_TEXT",
    "MATRICES",
    "MODP",
    "ORBSLAM3",
    "PLY",
    "REPLICA",
    "SCENE",
    "SEVENSCENES",
    "STELLA",
    "TANKSANDTEMPLES",
    "TRANSFORMS",
    "TUM",
    "TUM_RGBD",
]

SCENE: dict[str, Corruption] = {
    "aliases that multiply": changed(lambda data: data + laughs(9).encode()),
    "an alias of itself": replaced("output: out", "output: &a [*a]"),
    "nested 10,000 deep": whole("[" * 10_000 + "]" * 10_000),
    "nested mappings": whole("".join(" " * n + "a:\n" for n in range(500))),
    "a million values": whole("source: [" + "1," * 100_000 + "1]"),
    "300 KiB": changed(lambda data: data + b"# " + b"x" * 300_000),
    "5000 digits": replaced("scale: 1.0", f"scale: {HUGE}"),
    "infinity": replaced("scale: 1.0", "scale: .inf"),
    "NaN": replaced("scale: 1.0", "scale: .nan"),
    "negative": replaced("scale: 1.0", "scale: -1"),
    "1e999": replaced("scale: 1.0", "scale: 1e999"),
    "a word for a number": replaced("scale: 1.0", "scale: large"),
    "an unknown key": replaced("scale: 1.0", "scael: 1.0"),
    "a key twice": replaced("scale: 1.0", "path: images"),
    "a list for a key": replaced("scale: 1.0", "[1, 2]: 1.0"),
    "a tag": replaced("path: images", "path: !!python/object/apply:os.system [ls]"),
    "a tab": replaced("  scale: 1.0", "\tscale: 1.0"),
    "two documents": changed(lambda data: data + b"---\n" + data),
    "a name of 300 letters": replaced("path: images", f"path: {'a' * 300}"),
    "a path of 5000 letters": replaced("path: images", f"path: {'ab/' * 1700}"),
    "a NUL in a name": replaced("path: images", 'path: "im\\0ages"'),
    "half a character": replaced("path: images", 'path: "im\\ud800ages"'),
    "a home of nobody": replaced("path: images", "path: ~nobody-of-this-name/images"),
    "an escape for the terminal": replaced("path: images", 'path: "\\e[2Jimages"'),
    "text alone": whole("hello"),
    "a list": whole("- source\n- tracker\n"),
    "JSON cut off": whole('{"source": {"path": '),
    "a directive": changed(lambda data: b"%YAML 9.9\n---\n" + data),
    "an anchor without a name": replaced("output: out", "output: & out"),
}

COLMAP_TEXT: dict[str, dict[str, Corruption]] = {
    "sparse/0/cameras.txt": {
        "an unknown model": replaced("PINHOLE", "PINHOLEX"),
        "parameters missing": whole("1 PINHOLE 48 36 40\n"),
        "a negative focal length": replaced("40.0 40.0", "-40.0 40.0"),
        "NaN": replaced("40.0 40.0", "nan 40.0"),
        "a huge focal length": replaced("40.0 40.0", "1e300 40.0"),
        "another size": replaced("48 36", "480 360"),
        "a huge size": replaced("48 36", "4000000000 4000000000"),
        "no camera": whole("# nothing\n"),
    },
    "sparse/0/images.txt": {
        "an unknown camera": replaced(" 1 frame-000000", " 9 frame-000000"),
        "a quaternion of length 0": replaced("1 1 0 0 0", "1 0 0 0 0"),
        "NaN in a pose": replaced("1 1 0 0 0", "1 nan 0 0 0"),
        "a huge position": replaced("2 1 0 0 0 -0.1", "2 1 0 0 0 1e200"),
        "an image twice": changed(lambda data: data + data),
        "names of nothing there": changed(lambda data: data.replace(b"frame", b"other")),
        "an observation of a point that is missing": changed(lambda data: data.rsplit(b" ", 1)[0] + b" 99999\n"),
        "words for pixels": changed(lambda data: data.rsplit(b" ", 3)[0] + b" left up 3\n"),
        "a name that is no UTF-8": changed(lambda data: data.replace(b"frame", b"fr\xff\xfeme", 1)),
    },
    "sparse/0/points3D.txt": {
        "words for a place": changed(lambda data: b"1 here there 3 0 0 0 0.5 1 0 2 0\n"),
        "an image that is missing": changed(lambda data: data + b"77 0 0 3 1 1 1 0.5 99 0 98 0\n"),
    },
}

COLMAP: dict[str, dict[str, Corruption]] = {
    "sparse/0/cameras.bin": {
        "2^63 cameras": patched(0, "<Q", 1 << 63),
        "more cameras than there are": patched(0, "<Q", 2),
        "fewer than there are": patched(0, "<Q", 0),
        "an unknown model": patched(12, "<i", 99),
        "a negative model": patched(12, "<i", -1),
        "a width of 2^40": patched(16, "<Q", 1 << 40),
        "a width of 0": patched(16, "<Q", 0),
        "NaN": patched(32, "<d", float("nan")),
        "a negative focal length": patched(32, "<d", -40.0),
        "a huge focal length": patched(32, "<d", 1e300),
        "a byte too many": appended(b"\0"),
    },
    "sparse/0/images.bin": {
        "2^63 images": patched(0, "<Q", 1 << 63),
        "more images than there are": patched(0, "<Q", 4),
        "2^60 observations": patched(8 + 64 + 23, "<Q", 1 << 60),
        "an unknown camera": patched(68, "<i", 9),
        "NaN in a pose": patched(12, "<d", float("nan")),
        "a quaternion of length 0": patched(12, "<4d", 0, 0, 0, 0),
        "a huge position": patched(44, "<d", 1e200),
        "a name without an end": changed(lambda data: data[:72] + b"x" * 2000),
        "a point that is missing": patched(-8, "<q", 99_999),
    },
    "sparse/0/points3D.bin": {
        "2^63 points": patched(0, "<Q", 1 << 63),
        "a track of 2^61": patched(8 + 43, "<Q", 1 << 61),
        "a point less": patched(0, "<Q", 39),
        "an image that is missing": patched(-8, "<i", 77),
    },
}

TRANSFORMS: dict[str, Corruption] = {
    "nested 100,000 deep": whole("[" * 100_000 + "]" * 100_000),
    "nested objects": whole('{"frames":' * 5_000 + "1" + "}" * 5_000),
    "a list": whole("[]"),
    "no frames": in_json(setting("frames", [])),
    "frames of text": in_json(setting("frames", ["a", "b"])),
    "a frame without a name": in_json(setting("frames/0/file_path", None)),
    "a name twice": in_json(lambda data: data["frames"].append(data["frames"][0])),
    "names of nothing there": changed(lambda data: data.replace(b"images/frame", b"other/name")),
    "a matrix of 3 numbers": in_json(setting("frames/1/transform_matrix", [1, 2, 3])),
    "a matrix of words": in_json(setting("frames/1/transform_matrix", [["a"] * 4] * 4)),
    "a matrix that is missing": in_json(setting("frames/1/transform_matrix", None)),
    "NaN in a matrix": in_json(setting("frames/1/transform_matrix/0/3", float("nan"))),
    "infinity in a matrix": in_json(setting("frames/1/transform_matrix/0/3", float("inf"))),
    "a huge number in a matrix": in_json(setting("frames/1/transform_matrix/0/3", 1e300)),
    "5000 digits in a matrix": replaced('"h": 36', f'"h": 36, "k1": {HUGE}'),
    "400 digits": replaced('"w": 48', f'"w": {"9" * 400}'),
    "shear": in_json(setting("frames/1/transform_matrix/0/1", 0.5)),
    "a mirror": in_json(setting("frames/1/transform_matrix/0/0", -1.0)),
    "a focal length of 0": in_json(setting("fl_x", 0)),
    "a focal length of 1e300": in_json(setting("fl_x", 1e300)),
    "a focal length of text": in_json(setting("fl_x", "forty")),
    "a focal length that is a list": in_json(setting("fl_x", [[[40]]] * 9999)),
    "a size of 1e300": in_json(setting("w", 1e300)),
    "a negative size": in_json(setting("w", -48)),
    "another size": in_json(setting("w", 480)),
    "a size that is true": in_json(setting("w", True)),
    "a lens of 1e200": in_json(setting("k1", 1e200)),
    "an unknown camera model": in_json(setting("camera_model", "EQUIRECTANGULAR")),
    "half a character": replaced("images/frame", "\\ud800images/frame"),
    "a bracket too many": changed(lambda data: data + b"]"),
    "text after it": changed(lambda data: data + b" and more"),
    "a quote without an end": changed(lambda data: data[:-3] + b'"' + b'\\"' * 200_000),
}

TUM: dict[str, dict[str, Corruption]] = {
    "trajectory.txt": rows_of("0.033333 0.1 0 0 0 0 0 1", 1, 2)
    | {
        "times that fall": with_line(3, "0.01 0.2 0 0 0 0 0 1"),
        "a time twice": with_line(3, "0.033333 0.2 0 0 0 0 0 1"),
        "a quaternion of length 0": with_line(2, "0.033333 0.1 0 0 0 0 0 0"),
        "a quaternion of length 2": with_line(2, "0.033333 0.1 0 0 0 0 0 2"),
        "a quaternion of 1e29": with_line(2, "0.033333 0.1 0 0 1e29 1e29 1e29 1e29"),
        "a position of 1e20": with_line(2, "0.033333 1e20 0 0 0 0 0 1"),
        "nine columns": with_line(2, "0.033333 0.1 0 0 0 0 0 1 5"),
        "times of another day": whole("99999.5 0 0 0 0 0 0 1\n99999.6 1 0 0 0 0 0 1\n"),
        "an image": whole(png_file(8, 8)),
    },
    "points.txt": rows_of("1 2 3", 1, 5) | {"points nobody sees": whole("0 0 -5\n0 0 -6\n")},
}

PLY: dict[str, Corruption] = {
    "2^60 vertices": changed(lambda data: data.replace(b"vertex 40", b"vertex 1152921504606846976")),
    "999,999,999,999 vertices": changed(lambda data: data.replace(b"vertex 40", b"vertex 999999999999")),
    "5000 digits of vertices": changed(lambda data: data.replace(b"vertex 40", b"vertex " + HUGE.encode())),
    "a negative number of vertices": changed(lambda data: data.replace(b"vertex 40", b"vertex -40")),
    "a vertex too many": changed(lambda data: data.replace(b"vertex 40", b"vertex 41")),
    "no vertex": changed(lambda data: data.replace(b"vertex 40", b"vertex 0")),
    "ASCII that is binary": changed(lambda data: data.replace(b"binary_little_endian", b"ascii")),
    "an unknown format": changed(lambda data: data.replace(b"binary_little_endian", b"binary_middle_endian")),
    "an unknown type": changed(lambda data: data.replace(b"float y", b"quad y")),
    "no z": changed(lambda data: data.replace(b"float z", b"float w")),
    "x twice": changed(lambda data: data.replace(b"float y", b"float x")),
    "a list": changed(lambda data: data.replace(b"float x", b"list uchar int x")),
    "no end of the header": changed(lambda data: data.replace(b"end_header", b"end_of_it")),
    "a header of a megabyte": changed(lambda data: b"ply\n" + b"comment x\n" * 100_000 + data[4:]),
    "100,000 properties": ply_file("format ascii 1.0\nelement vertex 1\n" + "property float x\n" * 3000, b"1 2 3\n"),
    "ASCII with words": ply_file(
        "format ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z", b"1 2 3\na b c\n"
    ),
    "ASCII with a column too few": ply_file(
        "format ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z", b"1 2 3\n1 2    \n"
    ),
    "NaN alone": changed(lambda data: data[:-480] + struct.pack("<f", float("nan")) * 120),
    "faces first": changed(lambda data: data.replace(b"element vertex", b"element face 3\nelement vertex")),
}

ORBSLAM3: dict[str, Corruption] = rows_of("1400000000050000000.0 0.1 0 0 0 0 0 1", 1, 1) | {
    "a 3x4 matrix a row": whole("1 0 0 0 0 1 0 0 0 0 1 0\n"),
}

TUM_RGBD: dict[str, Corruption] = {
    "a time without a path": with_line(2, "0.05"),
    "NaN for a time": with_line(2, "nan rgb/a.png"),
    "infinity for a time": with_line(2, "inf rgb/a.png"),
    "a word for a time": with_line(2, "now rgb/a.png"),
    "1e300 for a time": with_line(2, "1e300 rgb/a.png"),
    "times that fall": with_line(3, "0.01 rgb/frame-000002.color.png"),
    "a path twice": with_line(3, "0.07 rgb/frame-000000.color.png"),
    "images that are missing": changed(lambda data: data.replace(b"rgb/frame", b"rgb/other")),
    "names of 300 letters": whole(f"0.5 {'a' * 300}.png\n"),
    "a NUL in a name": whole("0.5 rgb/a\0b.png\n"),
    "comments alone": whole("# nothing\n"),
}

REPLICA: dict[str, Corruption] = rows_of("1 0 0 0.1 0 1 0 0 0 0 1 0 0 0 0 1", 3, 1) | {
    "shear": with_line(1, "1 0.5 0 0.1 0 1 0 0 0 0 1 0 0 0 0 1"),
    "a mirror": with_line(1, "-1 0 0 0.1 0 1 0 0 0 0 1 0 0 0 0 1"),
    "zeros for a matrix": with_line(1, "0 " * 16),
    "another last row": with_line(1, "1 0 0 0.1 0 1 0 0 0 0 1 0 0 0 1 1"),
    "a position of 1e20": with_line(1, "1 0 0 1e20 0 1 0 0 0 0 1 0 0 0 0 1"),
    "a rotation of 1e20": with_line(1, "1e20 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"),
}

MATRICES: dict[str, Corruption] = rows_of("1 0 0 0.1 0 1 0 0 0 0 1 0", 3, 1) | {
    "shear": with_line(1, "1 0.5 0 0.1 0 1 0 0 0 0 1 0"),
    "a mirror": with_line(1, "-1 0 0 0.1 0 1 0 0 0 0 1 0"),
    "zeros for a matrix": with_line(1, "0 " * 12),
    "a position of 1e20": with_line(1, "1 0 0 1e20 0 1 0 0 0 0 1 0"),
    "four columns more": with_line(1, "1 0 0 0.1 0 1 0 0 0 0 1 0 0 0 0 1"),
}

TANKSANDTEMPLES: dict[str, Corruption] = rows_of("1 0 0 0.1", 3, 6) | {
    "words for integers": with_line(5, "one 1 0"),
    "a fraction for an integer": with_line(5, "0.5 1 0"),
    "a negative position": with_line(5, "-1 1 0"),
    "a position of 1e20": with_line(5, "1e20 1 0"),
    "two integers": with_line(5, "1 1"),
    "an image twice": with_line(5, "0 1 0"),
    "images that are missing": whole("7 7 0\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
    "images that are not registered": changed(lambda data: data.replace(b"0 0 0\n", b"0 -1 0\n", 1)[:40]),
    "shear": with_line(6, "1 0.5 0 0.1"),
    "a mirror": with_line(6, "-1 0 0 0.1"),
    "another last row": with_line(9, "0 0 1 1"),
}

SEVENSCENES: dict[str, Corruption] = rows_of("1 0 0 0.1", 3, 0) | {
    "a row too few": whole("1 0 0 0\n0 1 0 0\n0 0 1 0\n"),
    "a row too many": appended(b"0 0 0 1\n"),
    "shear": with_line(0, "1 0.5 0 0.1"),
}

MODP: dict[str, dict[str, Corruption]] = {
    "trajectory.json": {
        "nested 100,000 deep": whole("[" * 100_000),
        "no cameras": in_json(setting("cameras", [])),
        "cameras of numbers": in_json(setting("cameras", [1, 2, 3])),
        "a camera without an image": in_json(setting("cameras/1/image", 7)),
        "an image twice": in_json(lambda data: data["cameras"].append(data["cameras"][0])),
        "a matrix of words": in_json(setting("cameras/1/T_camera_world", "abc")),
        "NaN in a matrix": in_json(setting("cameras/1/T_camera_world/0/3", float("nan"))),
        "a huge number": in_json(setting("cameras/1/T_camera_world/0/3", 1e300)),
        "5000 digits": replaced("0.0", HUGE),
        "half a character": replaced("frame-000000", "\\udfff"),
        "text after it": appended(b"}"),
    },
    "point_cloud/point_cloud_1.txt": rows_of("1 2 3", 1, 2),
    "point_cloud/point_cloud_2.npy": {
        "2^50 rows": npy_file("{'descr': '<f4', 'fortran_order': False, 'shape': (1125899906842624, 3), }"),
        "brackets without an end": npy_file("{'descr': '<f4', 'fortran_order': False, 'shape': (8, (3, }"),
        "negative rows": npy_file("{'descr': '<f4', 'fortran_order': False, 'shape': (-8, 3), }"),
        "one column": npy_file("{'descr': '<f4', 'fortran_order': False, 'shape': (24,), }"),
        "two columns": npy_file("{'descr': '<f4', 'fortran_order': False, 'shape': (12, 2), }"),
        "text": npy_file("{'descr': '<U4', 'fortran_order': False, 'shape': (2, 3), }"),
        "objects": npy_file("{'descr': '|O', 'fortran_order': False, 'shape': (2, 3), }"),
        "code for a header": npy_file("__import__('os').system('true')"),
        "a header without an end": npy_file("{'descr': ('<f4'"),
        "a header cut off": changed(lambda data: data[:40]),
        "a pickle in it": pickled_npy,
        "a pickle alone": whole(b"\x80\x04\x95\x0b\0\0\0\0\0\0\0\x8c\x02os\x94\x8c\x06system\x94\x93\x94."),
        "an archive": archive_npy,
        "NaN": patched(-12, "<f", float("nan")),
    },
}

ARIA: dict[str, dict[str, Corruption]] = {
    "closed_loop_trajectory.csv": {
        "no header": changed(lambda data: data.split(b"\n", 1)[1]),
        "a column that is missing": replaced("tx_world_device", "tx"),
        "a row too short": with_line(2, "g1,33333,0,0.1,0,0"),
        "NaN": with_line(2, "g1,33333,0,nan,0,0,0,0,0,1,1.0"),
        "1e300": with_line(2, "g1,33333,0,1e300,0,0,0,0,0,1,1.0"),
        "a word": with_line(2, "g1,33333,0,far,0,0,0,0,0,1,1.0"),
        "a time of 5000 digits": with_line(2, f"g1,{HUGE},0,0.1,0,0,0,0,0,1,1.0"),
        "a time with a fraction": with_line(2, "g1,3.5,0,0.1,0,0,0,0,0,1,1.0"),
        "times that fall": with_line(3, "g1,5,0,0.1,0,0,0,0,0,1,1.0"),
        "a quaternion of length 0": with_line(2, "g1,33333,0,0.1,0,0,0,0,0,0,1.0"),
        "a header alone": changed(lambda data: data.split(b"\n", 1)[0] + b"\n"),
    },
    "online_calibration.jsonl": {
        "another camera": changed(lambda data: data.replace(b"camera-rgb", b"camera-slam")),
        "no cameras": with_line(1, '{"tracking_timestamp_us": 5}'),
        "a list": with_line(1, "[1, 2]"),
        "an empty object": with_line(1, "{}"),
        "a quaternion of 3": replaced("[1.0, [0.0, 0.0, 0.0]]", "[1.0, [0.0, 0.0]]"),
        "nested 5000 deep": with_line(1, "[" * 5000),
        "NaN": replaced("[0.0, 0.0, 0.0]", "[NaN, 0.0, 0.0]"),
        "5000 digits": replaced("[0.0, 0.0, 0.0]", f"[{HUGE}, 0.0, 0.0]"),
        "a translation of 2": replaced("[0.0, 0.0, 0.0]", "[0.0, 0.0]"),
    },
    "semidense_points.csv.gz": {
        "a gzip bomb": in_gz(bomb),
        "a gzip bomb without a line": in_gz(lambda text: b"0" * 50_000_000),
        "a header alone": in_gz(lambda text: text.split("\n", 1)[0] + "\n"),
        "NaN": in_gz(lambda text: text.replace("0.001", "nan", 1)),
        "a word": in_gz(lambda text: text.replace("0.001", "sure", 1)),
        "a row too short": in_gz(lambda text: text + "1,2,3\n"),
        "another world": in_gz(lambda text: text.replace("g1", "g2")),
        "a byte that is no text": in_gz(lambda text: text.encode() + b"\xff\xff"),
        "a checksum that is wrong": patched(-8, "<I", 12345),
        "plain text": changed(gzip.decompress),
        "a number of 5000 digits": in_gz(lambda text: text.replace("\n1,", f"\n{HUGE},", 1)),
    },
    "semidense_observations.csv": {
        "no observation of a point": whole("uid,frame_tracking_timestamp_us\n999,5\n"),
        "a row too short": appended(b"1,2\n"),
        "a word": appended(b"one,2,3,4,5\n"),
    },
}

STELLA: dict[str, Corruption] = {
    "2^32 keyframes": changed(lambda data: b"\x81\xa9keyframes\xdf\xff\xff\xff\xff"),
    "nested arrays of 50,000": changed(lambda data: b"\x81\xa9keyframes" + b"\xdc\xc3\x50" * 900),
    "nested 2000 deep": changed(lambda data: b"\x91" * 2000),
    "a text of 2^32": changed(lambda data: b"\x81\xdb\xff\xff\xff\xff" + data),
    "a list": whole(msgpack.packb([1, 2, 3])),
    "a number": whole(msgpack.packb(7)),
    "an SQLite map": whole(b"SQLite format 3\0" + bytes(100)),
    "no cameras": in_stella(lambda data: data.pop("cameras")),
    "no keyframes": in_stella(key_of("keyframes", {})),
    "no landmarks": in_stella(key_of("landmarks", {})),
    "keyframes in a list": in_stella(key_of("keyframes", [1, 2])),
    "a keyframe called by a word": in_stella(lambda data: data["keyframes"].update(one=data["keyframes"].pop("1"))),
    "a keyframe without a pose": in_stella(lambda data: data["keyframes"]["1"].pop("rot_cw")),
    "a quaternion of length 2": in_stella(key_of("keyframes/1/rot_cw", [0, 0, 0, 2.0])),
    "NaN in a pose": in_stella(key_of("keyframes/1/trans_cw", [float("nan"), 0, 0])),
    "1e300 in a pose": in_stella(key_of("keyframes/1/trans_cw", [1e300, 0, 0])),
    "a position of 2": in_stella(key_of("keyframes/1/trans_cw", [1.0, 0.0])),
    "keypoints without places": in_stella(key_of("keyframes/1/undist_keypts", [{}] * 40)),
    "fewer keypoints than landmarks": in_stella(key_of("keyframes/1/undist_keypts", [])),
    "a landmark that is missing": in_stella(lambda data: data["landmarks"].pop("3")),
    "a landmark id of text": in_stella(key_of("keyframes/1/lm_ids", ["a"] * 40)),
    "a landmark at NaN": in_stella(key_of("landmarks/3/pos_w", [0.0, float("nan"), 1.0])),
    "a camera that is missing": in_stella(key_of("keyframes/1/cam", "other")),
    "an unknown lens": in_stella(key_of("cameras/lens/model_type", "Equirectangular")),
    "a focal length of 0": in_stella(key_of("cameras/lens/fx", 0.0)),
    "a focal length of 1e300": in_stella(key_of("cameras/lens/fx", 1e300)),
    "a focal length of text": in_stella(key_of("cameras/lens/fx", "forty")),
    "two keyframes of one time": in_stella(key_of("keyframes/1/ts", 0.0)),
    "text that is no UTF-8": changed(lambda data: data.replace(b"lens", b"l\xff\xfes", 1)),
}
