"""Possible interpretations of given poses and intrinsics: as stated, or with one of the common mistakes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3, matrix_from_quaternion, quaternion_from_matrix
from modp_ti.inputs.capture import OPENCV_OPENGL

# From the axes of a body in ROS (x forward, y left, z up) to those of its camera.
BODY = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Convention:
    """An interpretation of the given poses and intrinsics.

    Attributes:
        name: Its name in reports.
        inverse: The poses are inverted (camera to world and world to camera are exchanged).
        opengl: The camera axes are OpenGL's (y up, z back).
        body: The camera axes are those of a body in ROS (x forward, y left, z up).
        intrinsics: Factor that corrects the focal lengths and the principal point.
        wxyz: The quaternions' components are w x y z, and were read as x y z w.
        shift: The pose of a frame is that of the frame so many places further on.
        focal: Additional factor that corrects the focal lengths.
        fault: What is wrong with the input if this interpretation fits.
        mend: How to correct it.
    """

    name: str
    inverse: bool = False
    opengl: bool = False
    body: bool = False
    wxyz: bool = False
    shift: int = 0
    intrinsics: float = 1.0
    focal: float = 1.0
    fault: str = ""
    mend: str = ""

    @property
    def code(self) -> str:
        """Its machine-readable identifier."""
        return self.name.replace(" ", "_").lower()

    def pose(self, T_camera_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """The correct T_camera_world (4, 4) under this interpretation, up to a rotation of the world."""
        T = inverse_se3(T_camera_world) if self.inverse else T_camera_world
        if self.wxyz:
            centre, read = inverse_se3(T)[:3, 3], quaternion_from_matrix(T[:3, :3].T)
            R = matrix_from_quaternion(np.roll(read, -1))
            return np.vstack([np.c_[R.T, -R.T @ centre], [0.0, 0.0, 0.0, 1.0]])
        if self.body:
            return BODY @ T
        return OPENCV_OPENGL @ T if self.opengl else T

    def camera(self, camera: PinholeCamera) -> PinholeCamera:
        """The correct camera under this interpretation, for the same image size."""
        f, c = self.intrinsics * self.focal, self.intrinsics
        return replace(camera, fx=f * camera.fx, fy=f * camera.fy, cx=c * camera.cx, cy=c * camera.cy)


STATED = Convention("as stated")
CONVENTIONS = (
    STATED,
    Convention(
        "inverse poses",
        inverse=True,
        fault="the poses are inverted: they fit the images as their inverses",
        mend="give the other direction: invert every pose (camera to world and world to camera are exchanged)",
    ),
    Convention(
        "OpenGL axes",
        opengl=True,
        fault="the poses have OpenGL axes (y up, z back) where OpenCV axes are expected, or the other way round",
        mend="multiply every camera-to-world matrix by diag(1, -1, -1, 1) from the right",
    ),
    Convention(
        "inverse poses with OpenGL axes",
        inverse=True,
        opengl=True,
        fault="the poses are inverted, and their axes are OpenGL's (y up, z back) where OpenCV's are expected",
        mend="invert every pose, and negate the second and third row of the world-to-camera matrix",
    ),
    Convention(
        "body axes",
        body=True,
        fault="the poses have the axes of a body in ROS (x forward, z up) where those of a camera are expected",
        mend="give the poses of the camera's optical frame (of a bag: set tracker.camera), or turn every pose from "
        "body to optical axes",
    ),
    Convention(
        "quaternions w x y z",
        wxyz=True,
        fault="the quaternions are in the order w x y z where x y z w is expected",
        mend="write their w last: time tx ty tz qx qy qz qw",
    ),
    Convention(
        "poses one image late",
        shift=1,
        fault="each image has the pose of the image before: its number or line is one too high",
        mend="count the images of poses and names alike, from 0 (programs that extract frames often count from 1)",
    ),
    Convention(
        "poses one image early",
        shift=-1,
        fault="each image has the pose of the image after: its number or line is one too low",
        mend="count the images of poses and names alike, from 0",
    ),
    Convention(
        "intrinsics of half the size",
        intrinsics=2.0,
        fault="the intrinsics belong to images of half the size",
        mend="multiply fx, fy, cx and cy by 2, or give the images that they were made for",
    ),
    Convention(
        "intrinsics of twice the size",
        intrinsics=0.5,
        fault="the intrinsics belong to images of twice the size",
        mend="multiply fx, fy, cx and cy by 0.5, or give the images that they were made for",
    ),
    Convention(
        "half the focal length",
        focal=2.0,
        fault="the focal length is half of what fits (the principal point is right)",
        mend="multiply fx and fy by 2",
    ),
    Convention(
        "twice the focal length",
        focal=0.5,
        fault="the focal length is twice what fits (the principal point is right)",
        mend="multiply fx and fy by 0.5",
    ),
)
