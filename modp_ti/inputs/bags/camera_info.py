"""CameraInfo messages as cameras."""

from __future__ import annotations

from typing import Any

from modp_ti.inputs.capture import checked_numbers, plausible_camera
from modp_ti.inputs.sources.distortion import NO_DISTORTION, lens_of_model
from modp_ti.inputs.sources.intrinsics import Intrinsics


def camera_of_info(message: Any, rectified: bool, where: str) -> Intrinsics | None:
    """Return the camera of a CameraInfo message; None if it says that it is not calibrated.

    Args:
        message: The message, of ROS 1 or ROS 2.
        rectified: Whether the images are rectified, so that the camera is that of `P`.
        where: Start of the error message.

    Raises:
        InputError: If it is no possible camera, or its lens model is not supported.
    """
    values = {name.lower(): list(map(float, getattr(message, name))) for name in "DKPdkp" if hasattr(message, name)}
    K, P = checked_numbers(values["k"], 9, f"{where}: K"), checked_numbers(values["p"], 12, f"{where}: P")
    fx, fy, cx, cy = (P[0], P[5], P[2], P[6]) if rectified else (K[0], K[4], K[2], K[5])
    if fx == 0.0:
        return None
    D = checked_numbers(values["d"], len(values["d"]), f"{where}: D")
    lens = NO_DISTORTION if rectified else lens_of_model(message.distortion_model, D, where)
    # The calibration has pixel centres at whole numbers.
    camera = plausible_camera(fx, fy, cx + 0.5, cy + 0.5, (message.width, message.height), where, lens)
    return Intrinsics(camera, lens)


def info_beside(topic: str, infos: list[str]) -> str | None:
    """Return the topic of CameraInfo that belongs to a topic of images, or None.

    It lies beside the images. The topic of compressed images lies below that of the images.
    """
    above = topic.rpartition("/")[0]
    while True:
        for beside in (f"{above}/camera_info", f"{above}/info/camera_info"):  # the second one is of RealSense Viewer
            if beside in infos:
                return beside
        if not above:
            return infos[0] if len(infos) == 1 else None
        above = above.rpartition("/")[0]


def is_rectified(topic: str) -> bool:
    """Whether the images of a topic are rectified, by its name."""
    name = topic.removesuffix("/compressed").removesuffix("/compressedDepth").rpartition("/")[2]
    return name.startswith("image_rect")
