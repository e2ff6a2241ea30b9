"""The malformed inputs: of each reader's files, what is spoilt and how. All of it is the same every time."""

from __future__ import annotations

import gzip
import io
import json
import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgpack
import numpy as np

from fault_injection.samples import SAMPLES

__all__ = ["CASES", "Case"]

Spoil = Callable[[Path], None]


@dataclass(frozen=True)
class Case:
    """spoil: called with the path of `file`, relative to the sample's folder. arguments: of `modp-ti`."""

    reader: str
    file: str
    name: str
    spoil: Spoil
    arguments: tuple[str, ...]


# ---- what can happen to any file --------------------------------------------------------------------------------


def _to(content: Callable[[bytes], bytes]) -> Spoil:
    def spoil(file: Path) -> None:
        file.write_bytes(content(file.read_bytes()))

    return spoil


def _folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


def _pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def _device(file: Path) -> None:
    file.unlink()
    file.symlink_to("/dev/zero")


def _circle(file: Path) -> None:
    file.unlink()
    file.symlink_to(file.name)


def _noise(data: bytes) -> bytes:
    return np.random.default_rng(len(data)).bytes(max(len(data), 64))


ANYWHERE: dict[str, Spoil] = {
    "empty": _to(lambda data: b""),
    "cut in half": _to(lambda data: data[: len(data) // 2]),
    "zeros": _to(lambda data: bytes(len(data))),
    "noise": _to(_noise),
    "noise before it": _to(lambda data: _noise(data)[:64] + data),
    "a folder": _folder,
    "a pipe": _pipe,
    "a device": _device,
    "a link to itself": _circle,
    "missing": Path.unlink,
}
TEXT: dict[str, Spoil] = {
    "UTF-16": _to(lambda data: data.decode().encode("utf-16")),
    "a byte that is no text": _to(lambda data: data[: len(data) // 2] + b"\xff\xfe" + data[len(data) // 2 :]),
    "a line without an end": _to(lambda data: b"1 " * 500_000 + data),
}


# ---- what can happen to text --------------------------------------------------------------------------------------


def _replace(old: str, new: str) -> Spoil:
    def spoil(file: Path) -> None:
        text = file.read_text()
        assert old in text, f"{file} holds no {old!r}"
        file.write_text(text.replace(old, new, 1))

    return spoil


def _line(number: int, new: str) -> Spoil:
    def spoil(file: Path) -> None:
        lines = file.read_text().splitlines()
        lines[number] = new
        file.write_text("\n".join(lines) + "\n")

    return spoil


def _all(content: str | bytes) -> Spoil:
    return _to(lambda data: content if isinstance(content, bytes) else content.encode())


def _json(change: Callable[[dict], object]) -> Spoil:
    def spoil(file: Path) -> None:
        data = json.loads(file.read_text())
        change(data)
        file.write_text(json.dumps(data))

    return spoil


HUGE = "9" * 5000
NUMBERS = {"NaN": "nan", "infinity": "inf", "a huge number": "1e300", "5000 digits": HUGE, "a word": "one"}


def _rows(line: str, place: int, at: int) -> dict[str, Spoil]:
    """A table of numbers with one of a row replaced. line: the row; at: its line."""
    words = line.split()
    cases = {
        f"{what} in a row": _line(at, " ".join([*words[:place], new, *words[place + 1 :]]))
        for what, new in NUMBERS.items()
    }
    return cases | {
        "a column too few": _line(at, " ".join(words[:-1]) if len(words) > 3 else " ".join(words[:2])),
        "comments alone": _all("# nothing\n# at all\n"),
    }


# ---- what can happen to binary files ------------------------------------------------------------------------------


def _patch(at: int, form: str, *values: float) -> Spoil:
    """Numbers over what stands at an offset; from the end where that is negative."""

    def change(data: bytes) -> bytes:
        start = at if at >= 0 else len(data) + at
        packed = struct.pack(form, *values)
        return data[:start] + packed + data[start + len(packed) :]

    return _to(change)


def _appended(more: bytes) -> Spoil:
    return _to(lambda data: data + more)


def _ply(header: str, body: bytes = b"") -> Spoil:
    return _all(f"ply\n{header}\nend_header\n".encode() + body)


def _png(width: int, height: int, content: bytes = b"\0" * 64) -> bytes:
    """A PNG whose checksums are right, whatever it says of its size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    start = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", start) + chunk(b"IDAT", zlib.compress(content)) + chunk(b"IEND", b"")


def _jpeg_size(width: int, height: int) -> Spoil:
    def change(data: bytes) -> bytes:
        at = data.index(b"\xff\xc0") + 5
        return data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]

    return _to(change)


def _npy(header: str, body: bytes = b"\0" * 96) -> Spoil:
    text = header.encode().ljust(117) + b"\n"
    return _all(b"\x93NUMPY\x01\0" + struct.pack("<H", len(text)) + text + body)


def _pickled_npy(file: Path) -> None:
    with file.open("wb") as stream:
        np.save(stream, np.array([{"a": 1}, None], dtype=object), allow_pickle=True)


def _archive_npy(file: Path) -> None:
    with io.BytesIO() as stream:
        np.savez(stream, a=np.zeros((3, 3)))
        file.write_bytes(stream.getvalue())


def _stella(change: Callable[[dict], object]) -> Spoil:
    def spoil(file: Path) -> None:
        data = msgpack.unpackb(file.read_bytes())
        change(data)
        file.write_bytes(msgpack.packb(data))

    return spoil


def _gz(change: Callable[[str], str | bytes]) -> Spoil:
    def spoil(file: Path) -> None:
        text = change(gzip.decompress(file.read_bytes()).decode())
        file.write_bytes(gzip.compress(text if isinstance(text, bytes) else text.encode(), 9, mtime=0))

    return spoil


def _bomb(text: str) -> str:
    header, row = text.splitlines()[:2]
    return header + "\n" + (row + "\n") * 1_000_000


def _set(path: str, value: object) -> Callable[[dict], None]:
    """Sets what stands at `a/b/0` of nested data."""
    *parents, last = [int(part) if part.isdecimal() else part for part in path.split("/")]

    def change(data: dict) -> None:
        for part in parents:
            data = data[part]
        data[last] = value

    return change


def _key(path: str, value: object) -> Callable[[dict], None]:
    """The same where every key is text."""
    *parents, last = path.split("/")

    def change(data: dict) -> None:
        for part in parents:
            data = data[part]
        data[last] = value

    return change


# ---- what is particular to each format --------------------------------------------------------------------------


def _laughs(levels: int) -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, levels)]
    return "\n".join(lines)


SCENE: dict[str, Spoil] = {
    "aliases that multiply": _to(lambda data: data + _laughs(9).encode()),
    "an alias of itself": _replace("output: out", "output: &a [*a]"),
    "nested 10,000 deep": _all("[" * 10_000 + "]" * 10_000),
    "nested mappings": _all("".join(" " * n + "a:\n" for n in range(500))),
    "a million values": _all("source: [" + "1," * 100_000 + "1]"),
    "300 KiB": _to(lambda data: data + b"# " + b"x" * 300_000),
    "5000 digits": _replace("scale: 1.0", f"scale: {HUGE}"),
    "infinity": _replace("scale: 1.0", "scale: .inf"),
    "NaN": _replace("scale: 1.0", "scale: .nan"),
    "negative": _replace("scale: 1.0", "scale: -1"),
    "1e999": _replace("scale: 1.0", "scale: 1e999"),
    "a word for a number": _replace("scale: 1.0", "scale: large"),
    "an unknown key": _replace("scale: 1.0", "scael: 1.0"),
    "a key twice": _replace("scale: 1.0", "path: images"),
    "a list for a key": _replace("scale: 1.0", "[1, 2]: 1.0"),
    "a tag": _replace("path: images", "path: !!python/object/apply:os.system [ls]"),
    "a tab": _replace("  scale: 1.0", "\tscale: 1.0"),
    "two documents": _to(lambda data: data + b"---\n" + data),
    "a name of 300 letters": _replace("path: images", f"path: {'a' * 300}"),
    "a path of 5000 letters": _replace("path: images", f"path: {'ab/' * 1700}"),
    "a NUL in a name": _replace("path: images", 'path: "im\\0ages"'),
    "half a character": _replace("path: images", 'path: "im\\ud800ages"'),
    "a home of nobody": _replace("path: images", "path: ~nobody-of-this-name/images"),
    "an escape for the terminal": _replace("path: images", 'path: "\\e[2Jimages"'),
    "text alone": _all("hello"),
    "a list": _all("- source\n- tracker\n"),
    "JSON cut off": _all('{"source": {"path": '),
    "a directive": _to(lambda data: b"%YAML 9.9\n---\n" + data),
    "an anchor without a name": _replace("output: out", "output: & out"),
}

COLMAP_TEXT: dict[str, dict[str, Spoil]] = {
    "sparse/0/cameras.txt": {
        "an unknown model": _replace("PINHOLE", "PINHOLEX"),
        "parameters missing": _all("1 PINHOLE 48 36 40\n"),
        "a negative focal length": _replace("40.0 40.0", "-40.0 40.0"),
        "NaN": _replace("40.0 40.0", "nan 40.0"),
        "a huge focal length": _replace("40.0 40.0", "1e300 40.0"),
        "another size": _replace("48 36", "480 360"),
        "a huge size": _replace("48 36", "4000000000 4000000000"),
        "no camera": _all("# nothing\n"),
    },
    "sparse/0/images.txt": {
        "an unknown camera": _replace(" 1 frame-000000", " 9 frame-000000"),
        "a quaternion of length 0": _replace("1 1 0 0 0", "1 0 0 0 0"),
        "NaN in a pose": _replace("1 1 0 0 0", "1 nan 0 0 0"),
        "a huge position": _replace("2 1 0 0 0 -0.1", "2 1 0 0 0 1e200"),
        "an image twice": _to(lambda data: data + data),
        "names of nothing there": _to(lambda data: data.replace(b"frame", b"other")),
        "an observation of a point that is missing": _to(lambda data: data.rsplit(b" ", 1)[0] + b" 99999\n"),
        "words for pixels": _to(lambda data: data.rsplit(b" ", 3)[0] + b" left up 3\n"),
        "a name that is no UTF-8": _to(lambda data: data.replace(b"frame", b"fr\xff\xfeme", 1)),
    },
    "sparse/0/points3D.txt": {
        "words for a place": _to(lambda data: b"1 here there 3 0 0 0 0.5 1 0 2 0\n"),
        "an image that is missing": _to(lambda data: data + b"77 0 0 3 1 1 1 0.5 99 0 98 0\n"),
    },
}

COLMAP: dict[str, dict[str, Spoil]] = {
    "sparse/0/cameras.bin": {
        "2^63 cameras": _patch(0, "<Q", 1 << 63),
        "more cameras than there are": _patch(0, "<Q", 2),
        "fewer than there are": _patch(0, "<Q", 0),
        "an unknown model": _patch(12, "<i", 99),
        "a negative model": _patch(12, "<i", -1),
        "a width of 2^40": _patch(16, "<Q", 1 << 40),
        "a width of 0": _patch(16, "<Q", 0),
        "NaN": _patch(32, "<d", float("nan")),
        "a negative focal length": _patch(32, "<d", -40.0),
        "a huge focal length": _patch(32, "<d", 1e300),
        "a byte too many": _appended(b"\0"),
    },
    "sparse/0/images.bin": {
        "2^63 images": _patch(0, "<Q", 1 << 63),
        "more images than there are": _patch(0, "<Q", 4),
        "2^60 observations": _patch(8 + 64 + 23, "<Q", 1 << 60),
        "an unknown camera": _patch(68, "<i", 9),
        "NaN in a pose": _patch(12, "<d", float("nan")),
        "a quaternion of length 0": _patch(12, "<4d", 0, 0, 0, 0),
        "a huge position": _patch(44, "<d", 1e200),
        "a name without an end": _to(lambda data: data[:72] + b"x" * 2000),
        "a point that is missing": _patch(-8, "<q", 99_999),
    },
    "sparse/0/points3D.bin": {
        "2^63 points": _patch(0, "<Q", 1 << 63),
        "a track of 2^61": _patch(8 + 43, "<Q", 1 << 61),
        "a point less": _patch(0, "<Q", 39),
        "an image that is missing": _patch(-8, "<i", 77),
    },
}

TRANSFORMS: dict[str, Spoil] = {
    "nested 100,000 deep": _all("[" * 100_000 + "]" * 100_000),
    "nested objects": _all('{"frames":' * 5_000 + "1" + "}" * 5_000),
    "a list": _all("[]"),
    "no frames": _json(_set("frames", [])),
    "frames of text": _json(_set("frames", ["a", "b"])),
    "a frame without a name": _json(_set("frames/0/file_path", None)),
    "a name twice": _json(lambda data: data["frames"].append(data["frames"][0])),
    "names of nothing there": _to(lambda data: data.replace(b"images/frame", b"other/name")),
    "a matrix of 3 numbers": _json(_set("frames/1/transform_matrix", [1, 2, 3])),
    "a matrix of words": _json(_set("frames/1/transform_matrix", [["a"] * 4] * 4)),
    "a matrix that is missing": _json(_set("frames/1/transform_matrix", None)),
    "NaN in a matrix": _json(_set("frames/1/transform_matrix/0/3", float("nan"))),
    "infinity in a matrix": _json(_set("frames/1/transform_matrix/0/3", float("inf"))),
    "a huge number in a matrix": _json(_set("frames/1/transform_matrix/0/3", 1e300)),
    "5000 digits in a matrix": _replace('"h": 36', f'"h": 36, "k1": {HUGE}'),
    "400 digits": _replace('"w": 48', f'"w": {"9" * 400}'),
    "shear": _json(_set("frames/1/transform_matrix/0/1", 0.5)),
    "a mirror": _json(_set("frames/1/transform_matrix/0/0", -1.0)),
    "a focal length of 0": _json(_set("fl_x", 0)),
    "a focal length of 1e300": _json(_set("fl_x", 1e300)),
    "a focal length of text": _json(_set("fl_x", "forty")),
    "a focal length that is a list": _json(_set("fl_x", [[[40]]] * 9999)),
    "a size of 1e300": _json(_set("w", 1e300)),
    "a negative size": _json(_set("w", -48)),
    "another size": _json(_set("w", 480)),
    "a size that is true": _json(_set("w", True)),
    "a lens of 1e200": _json(_set("k1", 1e200)),
    "an unknown camera model": _json(_set("camera_model", "EQUIRECTANGULAR")),
    "half a character": _replace("images/frame", "\\ud800images/frame"),
    "a bracket too many": _to(lambda data: data + b"]"),
    "text after it": _to(lambda data: data + b" and more"),
    "a quote without an end": _to(lambda data: data[:-3] + b'"' + b'\\"' * 200_000),
}

TUM: dict[str, dict[str, Spoil]] = {
    "trajectory.txt": _rows("0.033333 0.1 0 0 0 0 0 1", 1, 2)
    | {
        "times that fall": _line(3, "0.01 0.2 0 0 0 0 0 1"),
        "a time twice": _line(3, "0.033333 0.2 0 0 0 0 0 1"),
        "a quaternion of length 0": _line(2, "0.033333 0.1 0 0 0 0 0 0"),
        "a quaternion of length 2": _line(2, "0.033333 0.1 0 0 0 0 0 2"),
        "a quaternion of 1e29": _line(2, "0.033333 0.1 0 0 1e29 1e29 1e29 1e29"),
        "a position of 1e20": _line(2, "0.033333 1e20 0 0 0 0 0 1"),
        "nine columns": _line(2, "0.033333 0.1 0 0 0 0 0 1 5"),
        "times of another day": _all("99999.5 0 0 0 0 0 0 1\n99999.6 1 0 0 0 0 0 1\n"),
        "an image": _all(_png(8, 8)),
    },
    "points.txt": _rows("1 2 3", 1, 5) | {"points nobody sees": _all("0 0 -5\n0 0 -6\n")},
}

PLY: dict[str, Spoil] = {
    "2^60 vertices": _to(lambda data: data.replace(b"vertex 40", b"vertex 1152921504606846976")),
    "999,999,999,999 vertices": _to(lambda data: data.replace(b"vertex 40", b"vertex 999999999999")),
    "5000 digits of vertices": _to(lambda data: data.replace(b"vertex 40", b"vertex " + HUGE.encode())),
    "a negative number of vertices": _to(lambda data: data.replace(b"vertex 40", b"vertex -40")),
    "a vertex too many": _to(lambda data: data.replace(b"vertex 40", b"vertex 41")),
    "no vertex": _to(lambda data: data.replace(b"vertex 40", b"vertex 0")),
    "ASCII that is binary": _to(lambda data: data.replace(b"binary_little_endian", b"ascii")),
    "an unknown format": _to(lambda data: data.replace(b"binary_little_endian", b"binary_middle_endian")),
    "an unknown type": _to(lambda data: data.replace(b"float y", b"quad y")),
    "no z": _to(lambda data: data.replace(b"float z", b"float w")),
    "x twice": _to(lambda data: data.replace(b"float y", b"float x")),
    "a list": _to(lambda data: data.replace(b"float x", b"list uchar int x")),
    "no end of the header": _to(lambda data: data.replace(b"end_header", b"end_of_it")),
    "a header of a megabyte": _to(lambda data: b"ply\n" + b"comment x\n" * 100_000 + data[4:]),
    "100,000 properties": _ply("format ascii 1.0\nelement vertex 1\n" + "property float x\n" * 3000, b"1 2 3\n"),
    "ASCII with words": _ply(
        "format ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z", b"1 2 3\na b c\n"
    ),
    "ASCII with a column too few": _ply(
        "format ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z", b"1 2 3\n1 2    \n"
    ),
    "NaN alone": _to(lambda data: data[:-480] + struct.pack("<f", float("nan")) * 120),
    "faces first": _to(lambda data: data.replace(b"element vertex", b"element face 3\nelement vertex")),
}

ORBSLAM3: dict[str, Spoil] = _rows("1400000000050000000.0 0.1 0 0 0 0 0 1", 1, 1) | {
    "a 3x4 matrix a row": _all("1 0 0 0 0 1 0 0 0 0 1 0\n"),
}

TUM_RGBD: dict[str, Spoil] = {
    "a time without a path": _line(2, "0.05"),
    "NaN for a time": _line(2, "nan rgb/a.png"),
    "infinity for a time": _line(2, "inf rgb/a.png"),
    "a word for a time": _line(2, "now rgb/a.png"),
    "1e300 for a time": _line(2, "1e300 rgb/a.png"),
    "times that fall": _line(3, "0.01 rgb/frame-000002.color.png"),
    "a path twice": _line(3, "0.07 rgb/frame-000000.color.png"),
    "images that are missing": _to(lambda data: data.replace(b"rgb/frame", b"rgb/other")),
    "names of 300 letters": _all(f"0.5 {'a' * 300}.png\n"),
    "a NUL in a name": _all("0.5 rgb/a\0b.png\n"),
    "comments alone": _all("# nothing\n"),
}

REPLICA: dict[str, Spoil] = _rows("1 0 0 0.1 0 1 0 0 0 0 1 0 0 0 0 1", 3, 1) | {
    "shear": _line(1, "1 0.5 0 0.1 0 1 0 0 0 0 1 0 0 0 0 1"),
    "a mirror": _line(1, "-1 0 0 0.1 0 1 0 0 0 0 1 0 0 0 0 1"),
    "zeros for a matrix": _line(1, "0 " * 16),
    "another last row": _line(1, "1 0 0 0.1 0 1 0 0 0 0 1 0 0 0 1 1"),
    "a position of 1e20": _line(1, "1 0 0 1e20 0 1 0 0 0 0 1 0 0 0 0 1"),
    "a rotation of 1e20": _line(1, "1e20 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"),
}

SEVENSCENES: dict[str, Spoil] = _rows("1 0 0 0.1", 3, 0) | {
    "a row too few": _all("1 0 0 0\n0 1 0 0\n0 0 1 0\n"),
    "a row too many": _appended(b"0 0 0 1\n"),
    "shear": _line(0, "1 0.5 0 0.1"),
}

MODP: dict[str, dict[str, Spoil]] = {
    "trajectory.json": {
        "nested 100,000 deep": _all("[" * 100_000),
        "no cameras": _json(_set("cameras", [])),
        "cameras of numbers": _json(_set("cameras", [1, 2, 3])),
        "a camera without an image": _json(_set("cameras/1/image", 7)),
        "an image twice": _json(lambda data: data["cameras"].append(data["cameras"][0])),
        "a matrix of words": _json(_set("cameras/1/T_camera_world", "abc")),
        "NaN in a matrix": _json(_set("cameras/1/T_camera_world/0/3", float("nan"))),
        "a huge number": _json(_set("cameras/1/T_camera_world/0/3", 1e300)),
        "5000 digits": _replace("0.0", HUGE),
        "half a character": _replace("frame-000000", "\\udfff"),
        "text after it": _appended(b"}"),
    },
    "point_cloud/point_cloud_1.txt": _rows("1 2 3", 1, 2),
    "point_cloud/point_cloud_2.npy": {
        "2^50 rows": _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (1125899906842624, 3), }"),
        "negative rows": _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-8, 3), }"),
        "one column": _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (24,), }"),
        "two columns": _npy("{'descr': '<f4', 'fortran_order': False, 'shape': (12, 2), }"),
        "text": _npy("{'descr': '<U4', 'fortran_order': False, 'shape': (2, 3), }"),
        "objects": _npy("{'descr': '|O', 'fortran_order': False, 'shape': (2, 3), }"),
        "code for a header": _npy("__import__('os').system('true')"),
        "a header without an end": _npy("{'descr': ('<f4'"),
        "a header cut off": _to(lambda data: data[:40]),
        "a pickle in it": _pickled_npy,
        "a pickle alone": _all(b"\x80\x04\x95\x0b\0\0\0\0\0\0\0\x8c\x02os\x94\x8c\x06system\x94\x93\x94."),
        "an archive": _archive_npy,
        "NaN": _patch(-12, "<f", float("nan")),
    },
}

ARIA: dict[str, dict[str, Spoil]] = {
    "closed_loop_trajectory.csv": {
        "no header": _to(lambda data: data.split(b"\n", 1)[1]),
        "a column that is missing": _replace("tx_world_device", "tx"),
        "a row too short": _line(2, "g1,33333,0,0.1,0,0"),
        "NaN": _line(2, "g1,33333,0,nan,0,0,0,0,0,1,1.0"),
        "1e300": _line(2, "g1,33333,0,1e300,0,0,0,0,0,1,1.0"),
        "a word": _line(2, "g1,33333,0,far,0,0,0,0,0,1,1.0"),
        "a time of 5000 digits": _line(2, f"g1,{HUGE},0,0.1,0,0,0,0,0,1,1.0"),
        "a time with a fraction": _line(2, "g1,3.5,0,0.1,0,0,0,0,0,1,1.0"),
        "times that fall": _line(3, "g1,5,0,0.1,0,0,0,0,0,1,1.0"),
        "a quaternion of length 0": _line(2, "g1,33333,0,0.1,0,0,0,0,0,0,1.0"),
        "a header alone": _to(lambda data: data.split(b"\n", 1)[0] + b"\n"),
    },
    "online_calibration.jsonl": {
        "another camera": _to(lambda data: data.replace(b"camera-rgb", b"camera-slam")),
        "no cameras": _line(1, '{"tracking_timestamp_us": 5}'),
        "a list": _line(1, "[1, 2]"),
        "an empty object": _line(1, "{}"),
        "a quaternion of 3": _replace("[1.0, [0.0, 0.0, 0.0]]", "[1.0, [0.0, 0.0]]"),
        "nested 5000 deep": _line(1, "[" * 5000),
        "NaN": _replace("[0.0, 0.0, 0.0]", "[NaN, 0.0, 0.0]"),
        "5000 digits": _replace("[0.0, 0.0, 0.0]", f"[{HUGE}, 0.0, 0.0]"),
        "a translation of 2": _replace("[0.0, 0.0, 0.0]", "[0.0, 0.0]"),
    },
    "semidense_points.csv.gz": {
        "a gzip bomb": _gz(_bomb),
        "a gzip bomb without a line": _gz(lambda text: b"0" * 50_000_000),
        "a header alone": _gz(lambda text: text.split("\n", 1)[0] + "\n"),
        "NaN": _gz(lambda text: text.replace("0.001", "nan", 1)),
        "a word": _gz(lambda text: text.replace("0.001", "sure", 1)),
        "a row too short": _gz(lambda text: text + "1,2,3\n"),
        "another world": _gz(lambda text: text.replace("g1", "g2")),
        "a byte that is no text": _gz(lambda text: text.encode() + b"\xff\xff"),
        "a checksum that is wrong": _patch(-8, "<I", 12345),
        "plain text": _to(gzip.decompress),
        "a number of 5000 digits": _gz(lambda text: text.replace("\n1,", f"\n{HUGE},", 1)),
    },
    "semidense_observations.csv": {
        "no observation of a point": _all("uid,frame_tracking_timestamp_us\n999,5\n"),
        "a row too short": _appended(b"1,2\n"),
        "a word": _appended(b"one,2,3,4,5\n"),
    },
}

STELLA: dict[str, Spoil] = {
    "2^32 keyframes": _to(lambda data: b"\x81\xa9keyframes\xdf\xff\xff\xff\xff"),
    "nested arrays of 50,000": _to(lambda data: b"\x81\xa9keyframes" + b"\xdc\xc3\x50" * 900),
    "nested 2000 deep": _to(lambda data: b"\x91" * 2000),
    "a text of 2^32": _to(lambda data: b"\x81\xdb\xff\xff\xff\xff" + data),
    "a list": _all(msgpack.packb([1, 2, 3])),
    "a number": _all(msgpack.packb(7)),
    "an SQLite map": _all(b"SQLite format 3\0" + bytes(100)),
    "no cameras": _stella(lambda data: data.pop("cameras")),
    "no keyframes": _stella(_key("keyframes", {})),
    "no landmarks": _stella(_key("landmarks", {})),
    "keyframes in a list": _stella(_key("keyframes", [1, 2])),
    "a keyframe called by a word": _stella(lambda data: data["keyframes"].update(one=data["keyframes"].pop("1"))),
    "a keyframe without a pose": _stella(lambda data: data["keyframes"]["1"].pop("rot_cw")),
    "a quaternion of length 2": _stella(_key("keyframes/1/rot_cw", [0, 0, 0, 2.0])),
    "NaN in a pose": _stella(_key("keyframes/1/trans_cw", [float("nan"), 0, 0])),
    "1e300 in a pose": _stella(_key("keyframes/1/trans_cw", [1e300, 0, 0])),
    "a position of 2": _stella(_key("keyframes/1/trans_cw", [1.0, 0.0])),
    "keypoints without places": _stella(_key("keyframes/1/undist_keypts", [{}] * 40)),
    "fewer keypoints than landmarks": _stella(_key("keyframes/1/undist_keypts", [])),
    "a landmark that is missing": _stella(lambda data: data["landmarks"].pop("3")),
    "a landmark id of text": _stella(_key("keyframes/1/lm_ids", ["a"] * 40)),
    "a landmark at NaN": _stella(_key("landmarks/3/pos_w", [0.0, float("nan"), 1.0])),
    "a camera that is missing": _stella(_key("keyframes/1/cam", "other")),
    "an unknown lens": _stella(_key("cameras/lens/model_type", "Equirectangular")),
    "a focal length of 0": _stella(_key("cameras/lens/fx", 0.0)),
    "a focal length of 1e300": _stella(_key("cameras/lens/fx", 1e300)),
    "a focal length of text": _stella(_key("cameras/lens/fx", "forty")),
    "two keyframes of one time": _stella(_key("keyframes/1/ts", 0.0)),
    "text that is no UTF-8": _to(lambda data: data.replace(b"lens", b"l\xff\xfes", 1)),
}

IMAGES: dict[str, dict[str, Spoil]] = {
    "images/0.png": {
        "20,000 x 20,000": _all(_png(20_000, 20_000)),
        "2^31 x 2^31": _all(_png(2**31 - 1, 2**31 - 1)),
        "0 x 0": _all(_png(0, 0)),
        "another size": _all(_png(49, 36, bytes(36 * 148))),
        "pixels missing": _all(_png(48, 36)),
        "a checksum that is wrong": _to(lambda data: data[:60] + bytes(40) + data[100:]),
        "no end": _to(lambda data: data[:-12]),
        "a GIF in its place": _all(b"GIF89a\xff\xff\xff\xff" + bytes(40)),
    },
    "images/1.jpg": {
        "65,000 x 65,000": _jpeg_size(65_000, 65_000),
        "0 x 0": _jpeg_size(0, 0),
        "another size": _jpeg_size(96, 72),
        "no end": _to(lambda data: data[:-2]),
        "a start alone": _all(b"\xff\xd8"),
        "padding alone": _all(b"\xff\xd8" + b"\xff" * 200_000),
    },
    "images/2.bmp": {
        "30,000 x 30,000": _patch(18, "<ii", 30_000, 30_000),
        "a negative size": _patch(18, "<ii", -48, 36),
        "2^31": _patch(18, "<ii", 2**31 - 1, 2**31 - 1),
    },
    "images/3.tiff": {"no directory": _patch(4, "<I", 2**32 - 2)},
    "images/4.webp": {"half of it": _to(lambda data: data[: len(data) * 2 // 3])},
    "images/5.ppm": {
        "60,000 x 60,000": _to(lambda data: data.replace(b"48 36", b"60000 60000")),
        "10^20 pixels": _to(lambda data: data.replace(b"48 36", b"99999999999 99999999999")),
        "a negative size": _to(lambda data: data.replace(b"48 36", b"-48 -36")),
        "one row too few": _to(lambda data: data[:-144]),
    },
}

MASK: dict[str, dict[str, Spoil]] = {
    "masks/frame-000001.color.png": {
        "another size": _all(_png(8, 8, bytes(8 * 25))),
        "30,000 x 30,000": _all(_png(30_000, 30_000)),
    },
    "vignette.png": {
        "black": _all(_png(48, 36, bytes(36 * 145))),
        "another shape": _all(_png(8, 36, b"\0" + b"\x7f" * 24 + bytes(35 * 25))),
        "30,000 x 30,000": _all(_png(30_000, 30_000)),
    },
}

VIDEO: dict[str, Spoil] = {
    "text": _all("a video of a room\n"),
    "no data": _to(lambda data: data[: data.index(b"mdat") + 4] + b"\0" * 64),
    "a box of 2^63": _to(lambda data: data + b"\0\0\0\1mdat\x7f" + b"\xff" * 7),
    "a Matroska start alone": _all(b"\x1aE\xdf\xa3\x9f"),
    "an AVI of nothing": _all(b"RIFF\x24\0\0\0AVI " + bytes(32)),
}

RUN: dict[str, dict[str, Spoil]] = {
    "out/splats.ply": {
        "2^60 Gaussians": _to(lambda data: data.replace(b"vertex 40", b"vertex 1152921504606846976")),
        "a negative number": _to(lambda data: data.replace(b"vertex 40", b"vertex -1")),
        "a Gaussian too many": _to(lambda data: data.replace(b"vertex 40", b"vertex 41")),
        "no Gaussian": _to(lambda data: data.replace(b"vertex 40", b"vertex 0")),
        "no opacity": _to(lambda data: data.replace(b"opacity", b"opaqity")),
        "double": _to(lambda data: data.replace(b"float opacity", b"double opacity")),
        "a property without a name": _to(lambda data: data.replace(b"property float nx", b"property float")),
        "five harmonics": _to(lambda data: data.replace(b"float nx", b"float f_rest_0")),
        "ASCII": _to(lambda data: data.replace(b"binary_little_endian", b"ascii")),
        "NaN": _patch(-4, "<f", float("nan")),
        "infinity": _patch(-28, "<f", float("inf")),
        "a megabyte of comments": _to(lambda data: b"ply\n" + b"comment\n" * 130_000 + data[4:]),
    },
    "out/trajectory.txt": _rows("0.033333 0.1 0 0 0 0 0 1", 1, 1)
    | {
        "a quaternion of length 0": _line(1, "0.03 0.1 0 0 0 0 0 0"),
        "a quaternion of 1e20": _line(1, "0.03 0.1 0 0 0 0 0 1e20"),
        "a pose too many": _appended(b"0.5 0 0 0 0 0 0 1\n"),
    },
    "out/frames.json": {
        "a list": _all("[]"),
        "near of 0": _json(_set("near", 0)),
        "near of infinity": _json(_set("near", float("inf"))),
        "a depth of NaN": _json(_set("scene_depth", float("nan"))),
        "a depth of text": _json(_set("scene_depth", "deep")),
        "a frame that is missing": _json(_set("keyframes", [0, 99])),
        "a negative frame": _json(_set("keyframes", [-1])),
        "a keyframe of text": _json(_set("keyframes", "012")),
        "no keyframes": _json(_set("keyframes", [])),
        "5000 digits": _replace("0.1", HUGE),
    },
    "out/colmap/images.bin": {
        "2^63 images": _patch(0, "<Q", 1 << 63),
        "an unknown camera": _patch(68, "<i", 9),
        "a way out of the folder": _to(lambda data: data.replace(b"frame-000000.color.png", b"../../../../../../../x")),
    },
    "out/colmap/cameras.bin": {
        "a fisheye": _patch(12, "<i", 5),
        "a size of 2^40": _patch(16, "<QQ", 1 << 40, 1 << 40),
        "NaN": _patch(32, "<d", float("nan")),
    },
}

PATH: dict[str, Spoil] = _rows("0.033333 0.1 0 0 0 0 0 1", 1, 1) | TEXT


def _cases() -> list[Case]:
    cases: list[Case] = []

    def add(reader: str, file: str, spoils: dict[str, Spoil], arguments: tuple[str, ...] | None = None) -> None:
        cases.extend(
            Case(reader, file, name, spoil, arguments or SAMPLES[reader][0].arguments) for name, spoil in spoils.items()
        )

    def anything(*without: str) -> dict[str, Spoil]:
        return {name: spoil for name, spoil in ANYWHERE.items() if name not in without}

    add("scene", "scene.yaml", anything() | TEXT | SCENE)
    for file, spoils in COLMAP_TEXT.items():
        without = {"sparse/0/images.txt": ("cut in half",), "sparse/0/points3D.txt": ("cut in half",)}.get(file, ())
        add("colmap_text", file, anything(*without) | spoils)
    for file, spoils in COLMAP.items():
        add("colmap", file, anything() | spoils)
    add("transforms", "transforms.json", anything() | TEXT | TRANSFORMS)
    for file, spoils in TUM.items():
        add("tum", file, anything() | TEXT | spoils)
    add("ply", "points.ply", anything() | PLY)
    add("orbslam3", "CameraTrajectory.txt", anything() | TEXT | ORBSLAM3)
    add("tum_rgbd", "rgb.txt", anything("cut in half") | TEXT | TUM_RGBD)
    add("replica", "traj.txt", anything() | TEXT | REPLICA)
    unseen = ("missing", "a folder", "a link to itself", "a pipe", "a device")  # what is as if it were not there
    add("sevenscenes", "seq/frame-000001.pose.txt", anything(*unseen) | TEXT | SEVENSCENES)
    add("modp", "trajectory.json", anything() | TEXT | MODP["trajectory.json"])
    for file in ("point_cloud/point_cloud_1.txt", "point_cloud/point_cloud_2.npy"):
        add("modp", file, anything("missing", "empty") | MODP[file])
    for file, spoils in ARIA.items():
        # A row that ends in the middle of its last number is a row.
        cut = ("cut in half",) if file.endswith("observations.csv") else ()
        add("aria", file, anything(*cut, *(unseen if file.startswith("semidense") else ())) | spoils)
    add("stella_vslam", "map.msg", anything("noise before it") | STELLA)
    for file, spoils in IMAGES.items():
        add("image", file, anything("missing", "a folder", "a link to itself") | spoils)
    for file, spoils in MASK.items():
        add("mask", file, anything(*(("a link to itself",) if file.startswith("masks") else ())) | spoils)
    add("video", "room.mp4", anything("noise before it") | VIDEO)
    for file, spoils in RUN.items():
        add("run", file, anything() | spoils)
    add("run", "path.txt", PATH, ("render", "out", "--path", "path.txt", "-o", "film.mp4", "--quiet"))
    return cases


CASES = _cases()
