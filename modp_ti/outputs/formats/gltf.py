"""Writes meshes and splats as binary glTF 2.0 (`.glb`), with y up: what is given in it is already turned.

    12 bytes    "glTF", version 2, length of the file
    JSON chunk  layout of the buffer, padded with spaces to four bytes
    BIN chunk   the arrays, each padded to four bytes; all numbers are little-endian

A mesh has colours of its vertices, linear as glTF requires, or a texture. Its material is unlit, because colours from
photographs already contain the shading. (Open3D's own writer puts the buffers as text into the JSON part, which most
readers refuse.)

Splats have the extension KHR_gaussian_splatting (release candidate of July 2026): a splat is a point of a primitive of
mode POINTS, with the attributes

    POSITION, COLOR_0 (4 x uint8, linear, for viewers that draw plain points)
    KHR_gaussian_splatting:ROTATION  x, y, z, w    :SCALE  linear    :OPACITY  0 to 1
    KHR_gaussian_splatting:SH_DEGREE_l_COEF_n      red, green, blue; the order and the signs are those of 3DGS files

The extension has no flag for anti-aliasing.
"""

from __future__ import annotations

import io
import json
import os
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from fields.map.gaussians import SH_C0
from modp_ti.files.atomic import replace_file
from modp_ti.outputs.formats.compressed_splats import HALF_TURN, TURNED, opacities, to_bits, unit_quaternions

POINTS, TRIANGLES, VERTICES, INDICES = 0, 4, 34962, 34963
# componentType and whether integers stand for [0, 1], by the type of an array's numbers.
COMPONENTS = {"uint8": (5121, True), "uint16": (5123, True), "uint32": (5125, False), "float32": (5126, False)}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
JPEG_QUALITY = 92
SPLATS, UNLIT = "KHR_gaussian_splatting", "KHR_materials_unlit"


class _Buffer:
    """The buffer of a file with the layout of its arrays."""

    def __init__(self) -> None:
        self.body = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, data: bytes, **more: int) -> int:
        """Append bytes, and return the number of their view."""
        self.views.append({"buffer": 0, "byteOffset": len(self.body), "byteLength": len(data), **more})
        self.body += data + bytes(-len(data) % 4)
        return len(self.views) - 1

    def add(self, values: NDArray, target: int = VERTICES, bounds: bool = False) -> int:
        """Append an array (N,) or (N, C), and return the number of its accessor. POSITION needs its bounds."""
        component, normalized = COMPONENTS[values.dtype.name]
        accessor = {
            "bufferView": self.view(values.astype(values.dtype.newbyteorder("<")).tobytes(), target=target),
            "componentType": component,
            "count": len(values),
            "type": TYPES[1 if values.ndim == 1 else values.shape[1]],
        }
        accessor |= {"normalized": True} if normalized else {}
        if bounds and len(values):
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def write(self, path: str | os.PathLike[str], extension: str, primitive: dict[str, Any], **more: Any) -> None:
        """Write the file, whose scene is one primitive."""
        document = {
            "asset": {"version": "2.0", "generator": "MODP-Ti"},
            "extensionsUsed": [extension],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [primitive]}],
            **more,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.body)}],
        }
        head = json.dumps(document, separators=(",", ":")).encode("ascii")
        head += b" " * (-len(head) % 4)
        chunks = struct.pack("<I4s", len(head), b"JSON") + head + struct.pack("<I4s", len(self.body), b"BIN\0")
        replace_file(path, struct.pack("<4sII", b"glTF", 2, 12 + len(chunks) + len(self.body)) + chunks + self.body)


def write_mesh_glb(
    path: str | os.PathLike[str],
    vertices: NDArray,
    triangles: NDArray,
    colours: NDArray[np.floating] | None = None,
    uv: NDArray | None = None,
    image: NDArray[np.uint8] | None = None,
) -> None:
    """Write a mesh with colours, or with a texture.

    Args:
        path: The file.
        vertices: (V, 3) positions with y up.
        triangles: (T, 3) vertex indices.
        colours: (V, 3) sRGB colours in [0, 1]; None for a texture.
        uv: (V, 2) places in the texture in [0, 1], from its upper left corner.
        image: (H, W, 3) sRGB colours of the texture.
    """
    buffer = _Buffer()
    primitive: dict[str, Any] = {"indices": buffer.add(triangles.astype(np.uint32).ravel(), INDICES)}
    attributes = {"POSITION": buffer.add(vertices.astype(np.float32), bounds=True)}
    metal: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    texture: dict[str, Any] = {}
    if colours is not None:
        rgba = np.column_stack([_linear(colours), np.ones(len(vertices))])
        attributes["COLOR_0"] = buffer.add(to_bits(rgba, 16).astype(np.uint16))
    if uv is not None and image is not None:
        attributes["TEXCOORD_0"] = buffer.add(uv.astype(np.float32))
        jpeg = io.BytesIO()
        Image.fromarray(image).save(jpeg, "JPEG", quality=JPEG_QUALITY)
        metal["baseColorTexture"] = {"index": 0}
        texture["textures"] = [{"source": 0}]
        texture["images"] = [{"bufferView": buffer.view(jpeg.getvalue()), "mimeType": "image/jpeg"}]
    primitive |= {"attributes": attributes, "material": 0, "mode": TRIANGLES}
    material = {"extensions": {UNLIT: {}}, "pbrMetallicRoughness": metal, "doubleSided": True}
    buffer.write(path, UNLIT, primitive, materials=[material], **texture)


def write_splat_glb(path: str | os.PathLike[str], state: Mapping[str, NDArray]) -> None:
    """Write Gaussians, turned by 180 degrees around x so that the y axis is up.

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
    """
    position, quaternion, scale, opacity, sh = upright_splats(state)
    rgba = np.column_stack([_linear(np.clip(0.5 + SH_C0 * sh[:, 0], 0, 1)), opacity])
    attributes: dict[str, NDArray] = {
        "POSITION": position,
        f"{SPLATS}:ROTATION": quaternion,
        f"{SPLATS}:SCALE": scale,
        f"{SPLATS}:OPACITY": opacity,
    }
    for k in range(sh.shape[1]):
        degree = int(k**0.5)
        attributes[f"{SPLATS}:SH_DEGREE_{degree}_COEF_{k - degree * degree}"] = sh[:, k]
    buffer = _Buffer()
    numbers = {name: buffer.add(v.astype(np.float32), bounds=name == "POSITION") for name, v in attributes.items()}
    numbers["COLOR_0"] = buffer.add(to_bits(rgba, 8).astype(np.uint8))
    about = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    buffer.write(path, SPLATS, {"attributes": numbers, "mode": POINTS, "extensions": {SPLATS: about}})


def upright_splats(state: Mapping[str, NDArray]) -> tuple[NDArray[np.float64], ...]:
    """Return Gaussians turned by 180 degrees around x, so that the y axis is up.

    Args:
        state: Gaussians by name, as from `GaussianField.to_numpy`.

    Returns:
        Positions (N, 3), unit quaternions (N, 4) as x, y, z, w, linear scales (N, 3), opacities (N,), SH (N, K, 3).
    """
    w, x, y, z = unit_quaternions(state).T
    # Half a turn around x is the quaternion (0, 1, 0, 0), w first, which multiplies from the left.
    quaternion = np.column_stack([w, -z, y, -x])
    sh = state["sh"] * np.concatenate([[1.0], TURNED])[: state["sh"].shape[1], None]
    scale = np.exp(state["log_scale"].astype(np.float64))
    return state["position"].astype(np.float64) * HALF_TURN, quaternion, scale, opacities(state), sh


def _linear(colours: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the linear values of sRGB colours in [0, 1]."""
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
