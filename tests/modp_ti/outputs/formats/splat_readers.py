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
ODD = [1, 2, 4, 7, 9, 11, 12, 14]  # harmonics that are odd in y and z together


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
    sh[:, [k for k in ODD if k <= coefficients]] *= -1
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


def read_ply(path: Path) -> State:
    vertex = PlyData.read(path)["vertex"]
    names = [p.name for p in vertex.properties]
    assert names[:9] == [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]

    def columns(*wanted: str) -> NDArray:
        return np.stack([vertex[name] for name in wanted], axis=1)

    # All coefficients of red come before those of green.
    rest = [name for name in names if name.startswith("f_rest_")]
    others = columns(*rest).reshape(len(vertex.data), 3, -1).transpose(0, 2, 1) if rest else np.zeros((0, 0, 3))
    constant = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    return {
        "position": columns(*"xyz"),
        "log_scale": columns("scale_0", "scale_1", "scale_2"),
        "quaternion": columns("rot_0", "rot_1", "rot_2", "rot_3"),
        "opacity_logit": vertex["opacity"],
        "sh": np.concatenate([constant, others], axis=1) if rest else constant,
    }


def read_glb(path: Path) -> State:
    """Read a GLB of splats from glTF 2.0 and KHR_gaussian_splatting."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + size])
    assert struct.unpack_from("<I4s", data, 20 + size) == (document["buffers"][0]["byteLength"], b"BIN\0")
    primitive = document["meshes"][0]["primitives"][0]
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert primitive["mode"] == 0 and document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")

    def attribute(name: str) -> NDArray:
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        start = 28 + size + view["byteOffset"]
        values = np.frombuffer(data, kind, accessor["count"] * width, start).reshape(-1, width)
        assert values.nbytes == view["byteLength"] and view["byteOffset"] % 4 == 0
        if "min" in accessor:
            np.testing.assert_array_equal(values.min(axis=0), np.float32(accessor["min"]))
        return values

    rest = [f"SH_DEGREE_{degree}_COEF_{n}" for degree in range(4) for n in range(2 * degree + 1)]
    rest = [name for name in rest if f"KHR_gaussian_splatting:{name}" in primitive["attributes"]]
    sh = np.stack([attribute(f"KHR_gaussian_splatting:{name}") for name in rest], axis=1).copy()
    sh[:, [k for k in ODD if k < sh.shape[1]]] *= -1
    x, y, z, w = attribute("KHR_gaussian_splatting:ROTATION").T
    opacity = attribute("KHR_gaussian_splatting:OPACITY")[:, 0]
    np.testing.assert_allclose(attribute("COLOR_0")[:, 3] / 255, opacity, atol=0.51 / 255)
    return {
        "position": attribute("POSITION") * [1, -1, -1],
        "log_scale": np.log(attribute("KHR_gaussian_splatting:SCALE")),
        # Multiplied from the left by the quaternion (0, -1, 0, 0), w first.
        "quaternion": np.stack([x, -w, z, -y], axis=1),
        "opacity_logit": logit(opacity),
        "sh": sh,
    }


def read_usd(path: Path) -> State:
    """Read the one prim of a stage through the schema that usd-core ships."""
    from pxr import Usd, UsdGeom, UsdVol

    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    turns = splats.GetOrientationsAttr().Get()
    wxyz = np.array([[q.GetReal(), *q.GetImaginary()] for q in turns]).reshape(-1, 4)
    coefficients = (splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() + 1) ** 2
    sh = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(-1, coefficients, 3)
    sh[:, [k for k in ODD if k < coefficients]] *= -1
    return {
        "position": np.array(splats.GetPositionsAttr().Get()).reshape(-1, 3) * [1, -1, -1],
        "log_scale": np.log(splats.GetScalesAttr().Get()).reshape(-1, 3),
        "quaternion": wxyz[:, [1, 0, 3, 2]] * [1, -1, 1, -1],  # (0, -1, 0, 0), w first, times it
        "opacity_logit": logit(np.array(splats.GetOpacitiesAttr().Get())),
        "sh": sh,
    }


READERS = {
    "ply": read_ply,
    "splat": read_splat,
    "spz": read_spz,
    "sog": read_sog,
    "compressed-ply": read_compressed_ply,
    "splat-glb": read_glb,
    "usd": read_usd,
}
