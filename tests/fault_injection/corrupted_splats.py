"""Corruptions of splats in the formats of other programs, by the file's name."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from collections.abc import Callable

from tests.fault_injection.corruptions import HUGE, Corruption, appended, changed, patched, setting, whole

__all__ = ["SPLATS"]

NAN, INFINITY = float("nan"), float("inf")


def in_gzip(at: int, form: str, *values: float) -> Corruption:
    """Overwrite numbers at an offset of the unpacked file."""

    def change(data: bytes) -> bytes:
        content, packed = gzip.decompress(data), struct.pack(form, *values)
        return gzip.compress(content[:at] + packed + content[at + len(packed) :], mtime=0)

    return changed(change)


def unpacked(change: Callable[[bytes], bytes]) -> Corruption:
    """Replace the unpacked file by the result of `change`."""
    return changed(lambda data: gzip.compress(change(gzip.decompress(data)), mtime=0))


def zstandard_bomb(count: int) -> bytes:
    """Return an `.spz` file of version 4 with so many Gaussians, all of zeros, in blocks that repeat one byte."""
    size = struct.Struct("<Q")

    def stream(length: int) -> bytes:
        blocks, left = b"", length
        while left > 0:
            block = min(left, 1 << 17)
            left -= block
            blocks += ((block << 3) | 2 | (left == 0)).to_bytes(3, "little") + b"\0"
        return b"\x28\xb5\x2f\xfd\xe0" + size.pack(length) + blocks

    sizes = [count * each for each in (9, 1, 3, 3, 4)]
    streams = [stream(length) for length in sizes]
    table = b"".join(size.pack(len(part)) + size.pack(length) for part, length in zip(streams, sizes, strict=True))
    return b"NGSP" + struct.pack("<II4BI12x", 4, count, 0, 12, 0, 5, 32) + table + b"".join(streams)


SPZ: dict[str, Corruption] = {
    "another magic": in_gzip(0, "<I", 7),
    "version 0": in_gzip(4, "<I", 0),
    "version 9": in_gzip(4, "<I", 9),
    "version 4 in gzip": in_gzip(4, "<I", 4),
    "2^32 Gaussians": in_gzip(8, "<I", 2**32 - 1),
    "90 million Gaussians": in_gzip(8, "<I", 90_000_000),
    "a Gaussian too many": in_gzip(8, "<I", 41),
    "no Gaussian": in_gzip(8, "<I", 0),
    "harmonics of degree 4": in_gzip(12, "<B", 4),
    "harmonics of degree 200": in_gzip(12, "<B", 200),
    "99 fractional bits": in_gzip(13, "<B", 99),
    "a header alone": unpacked(lambda data: data[:16]),
    "half a header": unpacked(lambda data: data[:8]),
    "a bomb": unpacked(lambda data: data[:16] + bytes(50_000_000)),
    "millions of version 4 in no bytes": whole(zstandard_bomb(12_000_000)),
    "a plain start": whole(b"NGSP" + struct.pack("<II4BI", 4, 40, 0, 12, 0, 6, 32) + bytes(200)),
    "a table beyond the end": whole(b"NGSP" + struct.pack("<II4BI", 4, 40, 0, 12, 0, 6, 2**32 - 1) + bytes(200)),
}


def in_sog(name: str, change: Callable[[bytes], bytes]) -> Corruption:
    """Replace a file in the archive by the result of `change`."""

    def content(data: bytes) -> bytes:
        with zipfile.ZipFile(io.BytesIO(data)) as packed:
            files = {each: packed.read(each) for each in packed.namelist()}
        files[name] = change(files[name])
        with io.BytesIO() as stream:
            with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as written:
                for each, part in files.items():
                    written.writestr(each, part)
            return stream.getvalue()

    return changed(content)


def meta(path: str, value: object) -> Corruption:
    """Set the value at a path of `meta.json`."""

    def change(data: bytes) -> bytes:
        document = json.loads(data)
        setting(path, value)(document)
        return json.dumps(document).encode()

    return in_sog("meta.json", change)


def of_size(width: int, height: int) -> Callable[[bytes], bytes]:
    """Return a function that states another size in a lossless WebP."""

    def change(data: bytes) -> bytes:
        at = data.index(b"VP8L") + 9
        (bits,) = struct.unpack_from("<I", data, at)
        bits = bits >> 28 << 28 | height - 1 << 14 | width - 1
        return data[:at] + struct.pack("<I", bits) + data[at + 4 :]

    return change


def packed_by(method: int) -> Corruption:
    """Pack the archive's files in another way, and `meta.json` with 60 million blanks."""

    def change(data: bytes) -> bytes:
        stream = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(data)) as packed, zipfile.ZipFile(stream, "w", method) as written:
            for each in packed.namelist():
                written.writestr(each, packed.read(each) + b" " * (60_000_000 if each == "meta.json" else 0))
        return stream.getvalue()

    return changed(change)


SOG: dict[str, Corruption] = {
    "no JSON": in_sog("meta.json", lambda data: data[:-9]),
    "nested 5000 deep": in_sog("meta.json", lambda data: b"[" * 5000),
    "5000 digits": in_sog("meta.json", lambda data: data.replace(b'"count":', b'"count":' + HUGE.encode())),
    "a list": in_sog("meta.json", lambda data: b"[]"),
    "a bomb of JSON": in_sog("meta.json", lambda data: b" " * 60_000_000 + data),
    "version 1": meta("version", 1),
    "a Gaussian too many": meta("count", 1000),
    "a negative number": meta("count", -1),
    "half a Gaussian": meta("count", 39.5),
    "no bounds": meta("means", {}),
    "a bound of words": meta("means/mins", ["a", "b", "c"]),
    "a bound of 10^400": meta("means/maxs", [10**400, 1, 1]),
    "a bound of NaN": meta("means/maxs", [NAN, 1, 1]),
    "a bound of 1e300": meta("means/maxs", [1e300, 1, 1]),
    "an empty codebook": meta("scales/codebook", []),
    "a codebook of lists": meta("sh0/codebook", [[0, 0]] * 256),
    "a codebook of lists for scales": meta("scales/codebook", [[0]] * 256),
    "a codebook too short": meta("scales/codebook", [0.0] * 255),
    "a million Gaussians": meta("count", 1 << 20),
    "a member of bzip2": packed_by(zipfile.ZIP_BZIP2),
    "a codebook of words": meta("sh0/codebook", ["a"] * 256),
    "an infinite codebook": meta("sh0/codebook", [INFINITY] * 256),
    "an image that is missing": meta("quats/files", ["other.webp"]),
    "an image without a name": meta("quats/files", [7]),
    "means of nothing": meta("means/files", []),
    "an image of noise": in_sog("quats.webp", lambda data: data[:20] + bytes(reversed(data[20:]))),
    "an image that is cut off": in_sog("scales.webp", lambda data: data[: len(data) // 2]),
    "an image of 16,384 x 16,384": in_sog("sh0.webp", of_size(16_384, 16_384)),
    "a bomb for an image": in_sog("sh0.webp", lambda data: data + bytes(60_000_000)),
    "no image": in_sog("means_l.webp", lambda data: b"GIF89a" + data),
}

# 32 bytes a Gaussian: position, scale, colour, rotation.
SPLAT: dict[str, Corruption] = {
    "a byte too many": appended(b"\0"),
    "a byte too few": changed(lambda data: data[:-1]),
    "31 bytes": changed(lambda data: data[:31]),
    "a byte alone": whole(b"\x80"),
    "text": whole("a map of a room\n"),
    "a PLY": whole(b"ply\nformat binary_little_endian 1.0\nend_header\n"),
    **{
        f"{name} for {what}": patched(at, "<f", value)
        for what, at in (("a position", 0), ("a scale", 12))
        for name, value in (("NaN", NAN), ("infinity", INFINITY))
    },
    "a scale of 0": patched(16, "<f", 0.0),
    "a negative scale": patched(20, "<f", -1.0),
    "NaN in the last": patched(-32, "<f", NAN),
    "a signalling NaN": patched(4, "<I", 0x7F800001),
}

# Header of 4096 bytes, header of the section, buckets, Gaussians.
KSPLAT: dict[str, Corruption] = {
    "version 0.2": patched(0, "<BB", 0, 2),
    "version 1.1": patched(0, "<BB", 1, 1),
    "no section": patched(4, "<I", 0),
    "two sections": patched(4, "<I", 2),
    "2^32 sections": patched(4, "<I", 2**32 - 1),
    "level 3": patched(20, "<H", 3),
    "level 0 of level 1": patched(20, "<H", 0),
    "a Gaussian too many": patched(4096, "<II", 41, 41),
    "2^32 Gaussians": patched(4096, "<II", 2**32 - 1, 2**32 - 1),
    "no Gaussian": patched(4096, "<I", 0),
    "more Gaussians than room": patched(4096, "<I", 41),
    "2^32 in a bucket": patched(4096 + 8, "<I4xf", 2**32 - 1, 0.0),
    "2^32 buckets": patched(4096 + 12, "<I", 2**32 - 1),
    "buckets of NaN": patched(4096 + 16, "<f", NAN),
    "buckets of infinity": patched(4096 + 16, "<f", INFINITY),
    "buckets of 8 bytes": patched(4096 + 20, "<H", 8),
    "2^32 full buckets": patched(4096 + 32, "<I", 2**32 - 1),
    "2^32 partly filled buckets": patched(4096 + 36, "<I", 2**32 - 1),
    "harmonics of degree 3": patched(4096 + 40, "<H", 3),
    "harmonics of degree 9": patched(4096 + 40, "<H", 9),
    "a bucket of 2^32": patched(5120, "<I", 2**32 - 1),
    "NaN for a scale": patched(-18, "<H", 0x7E00),
    "a negative scale": patched(-18, "<H", 0xBC00),
    "infinity for a rotation": patched(-8, "<H", 0x7C00),
    "a header alone": changed(lambda data: data[:4096]),
}

COMPRESSED_PLY: dict[str, Corruption] = {
    "2^60 Gaussians": changed(lambda data: data.replace(b"vertex 40", b"vertex 1152921504606846976")),
    "5000 digits": changed(lambda data: data.replace(b"vertex 40", b"vertex " + HUGE.encode())),
    "a negative number": changed(lambda data: data.replace(b"vertex 40", b"vertex -1")),
    "a Gaussian too many": changed(lambda data: data.replace(b"vertex 40", b"vertex 41")),
    "no Gaussian": changed(lambda data: data.replace(b"vertex 40", b"vertex 0")),
    "an element without a number": changed(lambda data: data.replace(b"element vertex 40", b"element 40")),
    "no chunk": changed(lambda data: data.replace(b"chunk 1", b"chunk 0")),
    "two chunks": changed(lambda data: data.replace(b"chunk 1", b"chunk 2")),
    "ASCII": changed(lambda data: data.replace(b"binary_little_endian", b"ascii")),
    "another order": changed(lambda data: data.replace(b"packed_position", b"packed_place")),
    "three harmonics": changed(
        lambda data: (
            data.replace(
                b"end_header",
                b"element sh 40\n" + b"".join(b"property uchar f_rest_%d\n" % i for i in range(3)) + b"end_header",
            )
            + bytes(120)
        )
    ),
    "a header without an end": changed(lambda data: data.replace(b"end_header", b"and_header")),
    "NaN for a bound": changed(lambda data: data.replace(b"end_header\n", b"end_header\n" + struct.pack("<f", NAN), 1)),
}

SPLATS: dict[str, dict[str, Corruption]] = {
    "a.spz": SPZ,
    "a.sog": SOG,
    "a.splat": SPLAT,
    "a.ksplat": KSPLAT,
    "a.compressed.ply": COMPRESSED_PLY,
}
