"""Captures: recordings that bring cameras and poses with their images. One file per kind reads its layout."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree, open_tree
from modp_ti.inputs.captures.arkitscenes import is_arkitscenes, read_arkitscenes
from modp_ti.inputs.captures.capture import Capture
from modp_ti.inputs.captures.euroc import is_euroc, read_euroc
from modp_ti.inputs.captures.kitti import is_kitti, read_kitti
from modp_ti.inputs.captures.nerfcapture import is_nerfcapture, read_nerfcapture
from modp_ti.inputs.captures.polycam import is_polycam, read_polycam
from modp_ti.inputs.captures.record3d import is_record3d, read_record3d
from modp_ti.inputs.captures.scanner_app import is_scanner_app, read_scanner_app
from modp_ti.inputs.captures.scannet import is_scannet, read_scannet
from modp_ti.inputs.captures.stray_scanner import is_stray_scanner, read_stray_scanner

__all__ = ["ARCHIVES", "KINDS", "read_capture", "recognised_capture"]

ARCHIVES = (".r3d", ".zip")
"""Suffixes of captures in one file."""


@dataclass(frozen=True)
class Kind:
    """A kind of capture.

    Attributes:
        recognise: Whether files are such a capture.
        read: Reads its frames.
        holds: What such a capture holds, for error messages.
    """

    recognise: Callable[[FileTree], bool]
    read: Callable[[FileTree], Capture]
    holds: str


KINDS = {
    "record3d": Kind(is_record3d, read_record3d, "metadata and rgbd/0.jpg, ..."),
    "scanner_app": Kind(is_scanner_app, read_scanner_app, "frame_00000.json, frame_00000.jpg, ..."),
    "stray_scanner": Kind(is_stray_scanner, read_stray_scanner, "rgb.mp4 and odometry.csv"),
    "polycam": Kind(is_polycam, read_polycam, "keyframes/images and keyframes/cameras"),
    "nerfcapture": Kind(is_nerfcapture, read_nerfcapture, "transforms.json and images/0.png, images/0.depth.png, ..."),
    "euroc": Kind(is_euroc, read_euroc, "mav0/cam0/data.csv and mav0/cam0/sensor.yaml"),
    "kitti": Kind(is_kitti, read_kitti, "calib.txt, times.txt and image_2 or image_0"),
    "scannet": Kind(is_scannet, read_scannet, "color, pose and intrinsic/intrinsic_color.txt"),
    "arkitscenes": Kind(is_arkitscenes, read_arkitscenes, "lowres_wide, lowres_wide_intrinsics and lowres_wide.traj"),
}
"""The kinds by `source.kind`, in the order in which they are tried."""


def recognised_capture(path: Path) -> str | None:
    """Return the kind of a folder or archive; None if it is no capture.

    Raises:
        InputError: If a file is no archive.
    """
    for tree in open_tree(path):
        for name, kind in KINDS.items():
            if kind.recognise(tree):
                tree.close()
                return name
        tree.close()
    return None


def read_capture(path: Path, kind: str) -> Capture:
    """Read a capture of this kind.

    Raises:
        InputError: If it is none, or malformed.
    """
    if not path.exists():
        raise InputError(f"{path}: no such capture (source.path)")
    trees = open_tree(path)
    tree = next((tree for tree in trees if KINDS[kind].recognise(tree)), None)
    if tree is None:
        trees[0].close()
        raise InputError(f"{path}: is no capture of kind {kind}, which holds {KINDS[kind].holds} (source.path)")
    try:
        return KINDS[kind].read(tree)
    except InputError:
        tree.close()
        raise
