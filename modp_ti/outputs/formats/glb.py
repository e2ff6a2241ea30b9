"""Writes a mesh with vertex colours or with a texture as binary glTF 2.0 (`.glb`).

Open3D's own writer puts the buffers as text into the JSON part, which most readers refuse.

    12 bytes    "glTF", version 2, length of the file
    JSON chunk  layout of the buffer, padded with spaces to four bytes
    BIN chunk   indices uint32 | positions 3 x float32 | colours 4 x uint16, linear as glTF requires
                or             ... | places in the texture 2 x float32 | JPEG

All numbers are little-endian. The material is unlit, because the colours from photographs already contain the shading.
"""

from __future__ import annotations

import io
import json
import os
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from modp_ti.files.atomic import replace_file

__all__ = ["glb_bytes", "linear_colours", "write_glb", "write_textured_glb"]

UINT8, UINT16, UINT32, FLOAT32 = 5121, 5123, 5125, 5126
POINTS, TRIANGLES, VERTICES, INDICES = 0, 4, 34962, 34963
JPEG_QUALITY = 92


def write_glb(
    path: str | os.PathLike[str], vertices: NDArray, triangles: NDArray, colours: NDArray[np.floating]
) -> None:
    """Write a mesh.

    Args:
        path: The file.
        vertices: (V, 3) positions with y up.
        triangles: (T, 3) vertex indices.
        colours: (V, 3) sRGB colours in [0, 1].
    """
    rgba = np.ones((len(vertices), 4))
    rgba[:, :3] = linear_colours(colours)
    values = np.round(np.clip(rgba, 0.0, 1.0) * 65535.0).astype("<u2")
    accessor = {"componentType": UINT16, "normalized": True, "type": "VEC4"}
    _write(path, vertices, triangles, "COLOR_0", values, accessor, None)


def write_textured_glb(
    path: str | os.PathLike[str], vertices: NDArray, triangles: NDArray, uv: NDArray, image: NDArray[np.uint8]
) -> None:
    """Write a mesh with a texture.

    Args:
        path: The file.
        vertices: (V, 3) positions with y up.
        triangles: (T, 3) vertex indices.
        uv: (V, 2) places in the image in [0, 1], from its upper left corner.
        image: (H, W, 3) sRGB colours.
    """
    jpeg = io.BytesIO()
    Image.fromarray(image).save(jpeg, "JPEG", quality=JPEG_QUALITY)
    accessor = {"componentType": FLOAT32, "type": "VEC2"}
    _write(path, vertices, triangles, "TEXCOORD_0", np.ascontiguousarray(uv, "<f4"), accessor, jpeg.getvalue())


def _write(
    path: str | os.PathLike[str],
    vertices: NDArray,
    triangles: NDArray,
    name: str,
    values: NDArray,
    accessor: dict[str, Any],
    jpeg: bytes | None,
) -> None:
    """Write a mesh with one attribute of its vertices, and with a texture unless `jpeg` is None."""
    positions = np.ascontiguousarray(vertices, "<f4")
    parts = [np.ascontiguousarray(triangles, "<u4").tobytes(), positions.tobytes(), values.tobytes()]
    targets = [{"target": INDICES}, {"target": VERTICES}, {"target": VERTICES}]
    if jpeg is not None:
        parts.append(jpeg)
        targets.append({})
    padded = [part + b"\0" * (-len(part) % 4) for part in parts]
    starts = np.cumsum([0, *map(len, padded)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(part), **target}
        for start, part, target in zip(starts, parts, targets, strict=False)
    ]
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    accessors = [
        {"bufferView": 0, "componentType": UINT32, "count": int(triangles.size), "type": "SCALAR"},
        {"bufferView": 1, "componentType": FLOAT32, "count": len(positions), "type": "VEC3", **bounds},
        {"bufferView": 2, "count": len(positions), **accessor},
    ]
    primitive = {"attributes": {"POSITION": 1, name: 2}, "indices": 0, "material": 0, "mode": TRIANGLES}
    metal: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    texture: dict[str, Any] = {}
    if jpeg is not None:
        metal["baseColorTexture"] = {"index": 0}
        texture = {"textures": [{"source": 0}], "images": [{"bufferView": 3, "mimeType": "image/jpeg"}]}
    document = {
        "asset": {"version": "2.0", "generator": "MODP-Ti"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [
            {"extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": metal, "doubleSided": True},
        ],
        **texture,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }
    replace_file(path, glb_bytes(document, b"".join(padded)))


def linear_colours(colours: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the linear values of sRGB colours in [0, 1]."""
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)


def glb_bytes(document: dict[str, Any], body: bytes) -> bytes:
    """Return the content of a file with this JSON part and this buffer, whose length is a multiple of four bytes."""
    head = json.dumps(document, separators=(",", ":")).encode("ascii")
    head += b" " * (-len(head) % 4)
    chunks = struct.pack("<I4s", len(head), b"JSON") + head + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
