"""Readers of the compressed forms of splats, from their published layouts: one number after the other."""

from __future__ import annotations

import gzip
import json
import struct
import zipfile
from pathlib import Path

import cv2
import numpy as np
import zstandard
from numpy.typing import NDArray
from plyfile import PlyData

State = dict[str, NDArray]
SH_C0 = 0.28209479177387814


def logit(opacity: NDArray) -> NDArray:
    opacity = np.clip(opacity, 0.5 / 255, 254.5 / 255)
    return np.log(opacity / (1 - opacity))


def read_splat(path: Path) -> State:
    data = path.read_bytes()
    rows = [struct.unpack_from("<3f3f4B4B", data, at) for at in range(0, len(data), 32)]
    table = np.array(rows, dtype=np.float64)
    return {
        "position": table[:, :3],
        "log_scale": np.log(table[:, 3:6]),
        "sh": (table[:, None, 6:9] / 255 - 0.5) / SH_C0,
        "opacity_logit": logit(table[:, 9] / 255),
        "quaternion": (table[:, 10:14] - 128) / 128,
    }


def read_spz(path: Path) -> State:
    data = path.read_bytes()
    if data[:4] == b"NGSP":
        streams, table = data[15], struct.unpack_from("<I", data, 16)[0]
        sizes = [struct.unpack_from("<QQ", data, table + 16 * i) for i in range(streams)]
        at, content = table + 16 * streams, data[:15] + b"\0"
        for there, here in sizes:
            content += zstandard.ZstdDecompressor().decompress(data[at : at + there], max_output_size=here)
            at += there
        assert at == len(data)
        data = content
    else:
        data = gzip.decompress(data)
        assert struct.unpack_from("<I", data, 4)[0] < 4
    magic, version, count, degree, fractional, flags, reserved = struct.unpack_from("<IIIBBBB", data)
    assert (magic, flags, reserved) == (0x5053474E, 1, 0)
    at = 16

    def take(each: int) -> NDArray:
        nonlocal at
        part = np.frombuffer(data, np.uint8, count * each, at).reshape(count, each).astype(np.int64)
        at += count * each
        return part

    places = take(9).reshape(count, 3, 3)
    fixed = places[..., 0] + (places[..., 1] << 8) + (places[..., 2] << 16)
    fixed = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed)
    alphas, colours, scales, rotations = take(1)[:, 0], take(3), take(3), take(3 if version == 2 else 4)
    coefficients = (degree + 1) ** 2 - 1
    rest = (take(3 * coefficients).reshape(count, coefficients, 3) - 128) / 128
    assert at == len(data)
    quaternion = np.zeros((count, 4))
    for row, (a, b, c, *more) in zip(quaternion, rotations.tolist(), strict=True):
        if version == 2:
            row[:3] = [value / 127.5 - 1 for value in (a, b, c)]
            row[3] = np.sqrt(max(1 - (row[:3] ** 2).sum(), 0))
            continue
        d = more[0]
        word = a | b << 8 | c << 16 | d << 24
        largest = word >> 30
        for place in (3, 2, 1, 0):  # x, y, z, w from the high bits down
            if place != largest:
                row[place] = np.sqrt(0.5) * (word & 511) / 511 * (-1 if word & 512 else 1)
                word >>= 10
        row[largest] = np.sqrt(1 - (row**2).sum())
    sh = np.concatenate([((colours / 255 - 0.5) / 0.15)[:, None], rest], axis=1)
    # Right, up, back to right, down, front: y and z change their signs, and with them what is odd in both together.
    odd = [1, 2, 4, 7, 9, 11, 12, 14]
    sh[:, [k for k in odd if k <= coefficients]] *= -1
    return {
        "position": fixed / 2.0**fractional * [1, -1, -1],
        "log_scale": scales / 16 - 10,
        "sh": sh,
        "opacity_logit": logit(alphas / 255),
        "quaternion": quaternion[:, [3, 0, 1, 2]] * [1, 1, -1, -1],
    }


def read_compressed_ply(path: Path) -> State:
    ply = PlyData.read(path)
    chunk, vertex = ply["chunk"], ply["vertex"]
    count = len(vertex.data)
    assert len(chunk.data) == -(-count // 256)
    of = np.arange(count) // 256

    def part(name: str, low: int, bits: int) -> NDArray:
        return (vertex[f"packed_{name}"].astype(np.int64) >> low & (1 << bits) - 1) / ((1 << bits) - 1)

    def between(name: str, share: NDArray) -> NDArray:
        least, most = chunk[f"min_{name}"][of].astype(np.float64), chunk[f"max_{name}"][of].astype(np.float64)
        return least + share * (most - least)

    fields = (("", 21, 11), ("", 11, 10), ("", 0, 11))
    position = [between(axis, part("position", low, bits)) for axis, (_, low, bits) in zip("xyz", fields, strict=True)]
    scale = [between(f"scale_{a}", part("scale", low, bits)) for a, (_, low, bits) in zip("xyz", fields, strict=True)]
    colour = [between(c, part("color", low, 8)) for c, low in (("r", 24), ("g", 16), ("b", 8))]
    largest = vertex["packed_rotation"] >> 30
    three = [(part("rotation", low, 10) - 0.5) * np.sqrt(2) for low in (20, 10, 0)]
    quaternion = np.zeros((count, 4))  # w, x, y, z
    for i in range(count):
        others = [place for place in range(4) if place != largest[i]]
        quaternion[i, others] = [value[i] for value in three]
        quaternion[i, largest[i]] = np.sqrt(1 - (quaternion[i] ** 2).sum())
    sh = ((np.stack(colour, axis=1) - 0.5) / SH_C0)[:, None]
    if "sh" in ply:
        names = [p.name for p in ply["sh"].properties]
        rest = np.stack([(ply["sh"][name].astype(np.float64) + 0.5) / 256 * 8 - 4 for name in names], axis=1)
        sh = np.concatenate([sh, rest.reshape(count, 3, -1).transpose(0, 2, 1)], axis=1)
    return {
        "position": np.stack(position, axis=1),
        "log_scale": np.stack(scale, axis=1),
        "sh": sh,
        "opacity_logit": logit(part("color", 0, 8)),
        "quaternion": quaternion,
    }


def read_sog(path: Path) -> State:
    with zipfile.ZipFile(path) as archive:
        meta = json.loads(archive.read("meta.json"))

        def pixels(part: dict, number: int = 0) -> NDArray:
            data = np.frombuffer(archive.read(part["files"][number]), np.uint8)
            image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
            if image.shape[2] == 3:
                image = np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])
            return image[..., [2, 1, 0, 3]].reshape(-1, 4).astype(np.int64)

        count = meta["count"]
        assert (meta["version"], meta["model"]) == (2, "antialiased")
        means = meta["means"]
        steps = (pixels(means, 0) + 256 * pixels(means, 1))[:count, :3]
        place = means["mins"] + steps / 65535 * (np.array(means["maxs"]) - means["mins"])
        scales = np.array(meta["scales"]["codebook"])[pixels(meta["scales"])[:count, :3]]
        quats = pixels(meta["quats"])[:count]
        sh0 = pixels(meta["sh0"])[:count]
        sh = np.array(meta["sh0"]["codebook"])[sh0[:, :3]][:, None]
        if "shN" in meta:
            coefficients = (meta["shN"]["bands"] + 1) ** 2 - 1
            table = np.array(meta["shN"]["codebook"])[pixels(meta["shN"], 0)[:, :3]].reshape(-1, coefficients, 3)
            labels = pixels(meta["shN"], 1)[:count]
            label = labels[:, 0] + 256 * labels[:, 1]
            assert label.max() < meta["shN"]["count"]
            sh = np.concatenate([sh, table[label]], axis=1)
    quaternion = np.zeros((count, 4))  # w, x, y, z
    for row, (a, b, c, largest) in zip(quaternion, quats.tolist(), strict=True):
        three = [(value / 255 * 2 - 1) * np.sqrt(0.5) for value in (a, b, c)]
        for place_of in range(4):
            if place_of != largest - 252:
                row[place_of] = three.pop(0)
        row[largest - 252] = np.sqrt(1 - (row**2).sum())
    return {
        "position": np.sign(place) * (np.exp(np.abs(place)) - 1),
        "log_scale": scales,
        "sh": sh,
        "opacity_logit": logit(sh0[:, 3] / 255),
        "quaternion": quaternion,
    }


def read_ksplat(path: Path) -> State:
    data = path.read_bytes()
    assert data[:2] == b"\0\1"
    most_sections, sections, most, count, level = struct.unpack_from("<4IH", data, 4)
    assert (most_sections, sections, most) == (1, 1, count)
    held, room, per_bucket, buckets, size = struct.unpack_from("<4If", data, 4096)
    stride, steps, full, partly, degree = struct.unpack_from("<H2xI4xIIH", data, 4096 + 20)
    assert (held, room, level, stride, full + partly) == (count, count, 1, 12, buckets)
    filled = struct.unpack_from(f"<{partly}I", data, 5120)
    places = 5120 + 4 * partly
    at = places + 12 * buckets
    rows: dict[str, list] = {name: [] for name in ("position", "log_scale", "quaternion", "opacity_logit", "sh")}
    for bucket in range(buckets):
        centre = np.array(struct.unpack_from("<3f", data, places + 12 * bucket))
        for _ in range(per_bucket if bucket < full else filled[bucket - full]):
            place, scale = struct.unpack_from("<3H", data, at), struct.unpack_from("<3e", data, at + 6)
            *rgb, alpha = data[at + 20 : at + 24]
            harmonics = list(struct.unpack_from(f"<{3 * ((degree + 1) ** 2 - 1)}e", data, at + 24))
            sh = [(np.array(rgb) / 255 - 0.5) / SH_C0]
            for each in range(1, degree + 1):
                width = 2 * each + 1
                red, green, blue = (harmonics[n * width : (n + 1) * width] for n in range(3))
                sh += [np.array(colour) for colour in zip(red, green, blue, strict=True)]
                del harmonics[: 3 * width]
            rows["position"].append((np.array(place) - steps) * size / 2 / steps + centre)
            rows["log_scale"].append(np.log(scale))
            rows["quaternion"].append(struct.unpack_from("<4e", data, at + 12))
            rows["opacity_logit"].append(logit(np.array(alpha / 255)))
            rows["sh"].append(sh)
            at += 24 + 6 * ((degree + 1) ** 2 - 1)
    assert at == len(data)
    return {name: np.array(values) for name, values in rows.items()}


READERS = {
    "splat": read_splat,
    "spz": read_spz,
    "sog": read_sog,
    "compressed-ply": read_compressed_ply,
    "ksplat": read_ksplat,
}
