"""Image sources, one file per kind. Images are decoded frame by frame."""

from __future__ import annotations

from modp_ti.inputs.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.inputs.sources.frame_reader import FrameReader, Picture
from modp_ti.inputs.sources.image_folder import ImageFolder
from modp_ti.inputs.sources.protocol import ImageSource, require_intrinsics
from modp_ti.inputs.sources.undistortion import Intrinsics, Undistorter
from modp_ti.inputs.sources.video_file import VideoFile

__all__ = [
    "NO_DISTORTION",
    "Distortion",
    "FrameReader",
    "ImageFolder",
    "ImageSource",
    "Intrinsics",
    "Picture",
    "Undistorter",
    "VideoFile",
    "require_intrinsics",
]
