"""Writes splats as OpenUSD: a `ParticleField3DGaussianSplat` of UsdVol, which came with version 26.03, y up.

    positions, orientations (unit quaternions), scales (linear), opacities (0 to 1): as floats
    radiance:sphericalHarmonicsCoefficients   red, green, blue; the coefficients of a Gaussian follow one another

The order and the signs of the harmonics are those of 3DGS files, and so are their colours, which are sRGB. The schema
has no flag for anti-aliasing.
"""
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.map.blocks import extent_of
from modp_ti.files.atomic import written_aside
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.gltf import upright_splats

USD_SUFFIXES = (".usdc", ".usd", ".usda")


def write_usd(path: Path, state: Mapping[str, NDArray]) -> None:
    """Write Gaussians, turned by 180 degrees around x so that the y axis is up. One unit of the map is one metre.

    Args:
        path: The file: binary as `.usd` and `.usdc`, text as `.usda`.
        state: Gaussians by name, as from `GaussianField.to_numpy`.

    Raises:
        InputError: If usd-core is not installed, or is older than the schema.
    """
    try:
        from pxr import Usd, UsdGeom, UsdVol, Vt  # pyright: ignore[reportMissingImports]  # an extra

        define = UsdVol.ParticleField3DGaussianSplat.Define
    except (ImportError, AttributeError):
        raise InputError("USD needs usd-core 26.3 or later: pip install 'modp-ti[usd]'") from None
    position, quaternion, scale, opacity, sh = (part.astype(np.float32) for part in upright_splats(state))
    reach = extent_of(np.log(scale))[:, None]
    with written_aside(Path(path)) as partial:
        stage = Usd.Stage.CreateNew(str(partial))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        splats = define(stage, "/Map")
        stage.SetDefaultPrim(splats.GetPrim())
        splats.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(position))
        splats.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(quaternion))  # x, y, z, w in memory
        splats.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scale))
        splats.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(opacity))
        splats.CreateRadianceSphericalHarmonicsDegreeAttr(round(sh.shape[1] ** 0.5) - 1)
        splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(sh.reshape(-1, 3)))
        if len(position):
            box = np.stack([(position - reach).min(axis=0), (position + reach).max(axis=0)])
            splats.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(box))
        stage.GetRootLayer().Save()
