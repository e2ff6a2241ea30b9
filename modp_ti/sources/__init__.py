"""Where images come from: one file per source, decoded frame by frame."""

from modp_ti.sources.distortion import NO_DISTORTION, Distortion
from modp_ti.sources.frame_reader import FrameReader, Picture
from modp_ti.sources.image_folder import ImageFolder
from modp_ti.sources.undistortion import Undistorter

__all__ = ["NO_DISTORTION", "Distortion", "FrameReader", "ImageFolder", "Picture", "Undistorter"]
