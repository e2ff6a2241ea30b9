"""`open_splats`: a PLY file of splats in place of a finished run, for `modp-ti view`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.run_files import FramesRecord
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.playback.camera_paths import looking_at
from modp_ti.outputs.playback.finished_run import FinishedRun

# Quantile of the distances from the centre that counts as the map's radius.
RADIUS = 0.8
# From where the camera looks at the centre, in radii: above and in front of it, with y down and z ahead.
PLACE = np.array([0.0, -0.5, -1.8])
NEAR = 0.01
CAMERA = PinholeCamera(640.0, 640.0, 480.0, 360.0, 960, 720)


@dataclass(frozen=True)
class SplatFile(FinishedRun):
    """A file of splats as a run of one frame.

    Attributes:
        splats: Gaussians as `GaussianField.load` takes them.
    """

    splats: dict[str, NDArray[np.float32]]

    @cached_property
    def gaussians(self) -> dict[str, NDArray[np.float32]]:
        return self.splats


def open_splats(path: Path) -> SplatFile:
    """Read a PLY file of splats as a run of one frame, from which the whole is seen.

    Raises:
        InputError: If the file is no PLY file of 3DGS, cannot be read, or holds no splat.
    """
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: splats are read from .ply; splat-transform converts other formats")
    state = read_splats(path)
    if len(state["position"]) == 0:
        raise InputError(f"{path}: holds no splat")
    centre = np.median(state["position"], axis=0).astype(np.float64)
    radius = max(float(np.quantile(np.linalg.norm(state["position"] - centre, axis=1), RADIUS)), 1e-9)
    T = looking_at(centre + radius * PLACE, centre, np.array([0.0, -1.0, 0.0]))
    depth = radius * float(np.linalg.norm(PLACE))
    record = FramesRecord(near=NEAR * depth, scene_depth=depth, keyframes=[0], held_out=[])
    return SplatFile(path, [path.name], np.zeros(1), T[None], [CAMERA], record, state)
