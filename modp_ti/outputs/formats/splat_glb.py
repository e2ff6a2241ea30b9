"""Writes splats as binary glTF with the extension KHR_gaussian_splatting (release candidate of July 2026).

A splat is a point of a primitive of mode POINTS. Its attributes are float32:

    POSITION, COLOR_0 (4 x uint8, linear, for viewers that draw plain points)
    KHR_gaussian_splatting:ROTATION  x, y, z, w    :SCALE  linear    :OPACITY  0 to 1
    KHR_gaussian_splatting:SH_DEGREE_l_COEF_n      red, green, blue; the order and the signs are those of 3DGS files

The y axis is up, so that the map is turned by 180 degrees around x. The extension has no flag for anti-aliasing.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import SH_C0
from modp_ti.files.atomic import replace_file
from modp_ti.outputs.formats.glb import FLOAT32, POINTS, UINT8, VERTICES, glb_bytes, linear_colours
from modp_ti.outputs.formats.splat_packing import opacities, to_bits, unit_quaternions
from modp_ti.outputs.formats.spz import HALF_TURN, TURNED

__all__ = ["write_splat_glb"]

EXTENSION = "KHR_gaussian_splatting"
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_splat_glb(path: str | os.PathLike[str], state: Mapping[str, NDArray]) -> None:
    """Write Gaussians.

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
    """
    w, x, y, z = unit_quaternions(state).T
    constant = state["sh"][:, 0].astype(np.float64)
    rgba = np.column_stack([linear_colours(np.clip(0.5 + SH_C0 * constant, 0, 1)), opacities(state)])
    attributes: dict[str, NDArray] = {
        "POSITION": state["position"].astype(np.float64) * HALF_TURN,
        "COLOR_0": to_bits(rgba, 8).astype(np.uint8),
        # Half a turn around x is the quaternion (0, 1, 0, 0), which multiplies from the left.
        f"{EXTENSION}:ROTATION": np.column_stack([w, -z, y, -x]),
        f"{EXTENSION}:SCALE": np.exp(state["log_scale"].astype(np.float64)),
        f"{EXTENSION}:OPACITY": opacities(state)[:, None],
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": constant,
    }
    for k in range(1, state["sh"].shape[1]):
        degree = int(k**0.5)
        name = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k - degree * degree}"
        attributes[name] = state["sh"][:, k].astype(np.float64) * TURNED[k - 1]
    parts, views, accessors, start = [], [], [], 0
    for values in attributes.values():
        part = values if values.dtype == np.uint8 else values.astype("<f4")
        kind = {"componentType": UINT8, "normalized": True} if part.dtype == np.uint8 else {"componentType": FLOAT32}
        accessor = {"bufferView": len(views), "count": len(part), "type": TYPES[part.shape[1]], **kind}
        if not accessors and len(part):  # glTF requires the bounds of POSITION
            accessor |= {"min": part.min(axis=0).tolist(), "max": part.max(axis=0).tolist()}
        accessors.append(accessor)
        views.append({"buffer": 0, "byteOffset": start, "byteLength": part.nbytes, "target": VERTICES})
        parts.append(part.tobytes())
        start += part.nbytes
    primitive = {
        "attributes": {name: number for number, name in enumerate(attributes)},
        "mode": POINTS,
        "extensions": {
            EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            }
        },
    }
    document = {
        "asset": {"version": "2.0", "generator": "MODP-Ti"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    replace_file(path, glb_bytes(document, b"".join(parts)))
