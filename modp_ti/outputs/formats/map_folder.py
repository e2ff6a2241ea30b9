"""Writes the files of a map to a folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fields.frames.origin import shifted_poses
from fields.map.keyframes import KeyframeStore
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.inputs.sources.undistortion import Undistorter
from modp_ti.outputs.evaluation import MapVersion
from modp_ti.outputs.formats.colmap_model import write_colmap
from modp_ti.outputs.formats.exposure import write_exposures
from modp_ti.outputs.formats.frames_json import write_frames
from modp_ti.outputs.formats.keyframe_masks import write_masks
from modp_ti.outputs.formats.splats_ply import write_splats
from modp_ti.outputs.formats.trajectory import write_trajectory

__all__ = ["NOT_ALWAYS", "write_map"]

NOT_ALWAYS = ("colmap", "exposure.json", "masks")
"""What `write_map` writes that another map may lack, or have other files in."""


def write_map(
    folder: Path,
    version: MapVersion,
    frames: DeliveredFrames,
    names: Sequence[str],
    keyframes: KeyframeStore,
    near: float,
    undistorter: Undistorter | None = None,
) -> None:
    """Write `splats.ply`, `trajectory.txt`, `frames.json` and `colmap/`.

    `exposure.json` is added where exposures are estimated, and `masks/` where keyframes are masked.

    Args:
        folder: An existing folder.
        version: The map.
        frames: Metadata and points of all frames.
        names: Image names for the COLMAP model.
        keyframes: The map's keyframes.
        near: Depth below which nothing is drawn [scene units].
        undistorter: Undistorter of the first frame's image, None if it is not known.
    """
    selected = {keyframe.index for keyframe in keyframes.selected}
    origin = frames.from_origin
    poses = [shifted_poses(T, origin) for T in version.trajectory]
    write_splats(folder / "splats.ply", version.gaussians, origin)
    write_trajectory(folder / "trajectory.txt", frames.timestamp, poses)
    write_colmap(folder / "colmap", names, frames.camera, poses, frames.points, origin)
    lines = [line for line, index in enumerate(frames.index) if index in selected]
    held_out = [line for line, held in enumerate(frames.held_out) if held]
    write_frames(folder / "frames.json", near, keyframes.scene_depth, lines, held_out, undistorter, origin)
    if any(exposure is not None for exposure in version.exposures):
        estimated = {keyframe.index for keyframe in keyframes if keyframe.exposure is not None}
        write_exposures(folder / "exposure.json", frames.index, frames.timestamp, version.exposures, estimated)
    places = {index: place for place, index in enumerate(frames.index)}
    masks = {places[view.index]: view.transient for view in keyframes if view.transient is not None}
    if masks:
        write_masks(folder / "masks", masks)
