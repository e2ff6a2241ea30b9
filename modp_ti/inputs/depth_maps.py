"""Depth maps in files, and the tracked points that are taken from them."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Sequence
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import IDS_PER_FRAME, SparsePoints
from fields.geometry.se3 import inverse_se3
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.capture import CapturedFrame, DepthMap
from modp_ti.inputs.replay import PosedImage, points_inside
from modp_ti.inputs.sources.image_header import decodable
from modp_ti.inputs.sources.image_pixels import decoded_as
from modp_ti.inputs.sources.orientation import Turn
from modp_ti.inputs.sources.undistortion import Undistorter

# Where the depths of a pixel and its eight neighbours differ by more than this share, the pixel lies on an edge: the
# sensor blends what is before and behind it.
EDGE = 0.05
# Largest number of points that a depth map gives a frame. No two frames have one in common, so that more say little of
# the others.
MOST_POINTS = 400
# The last number in a name; by how much those of an image and its depth picture may differ; and no depth.
NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?(?=[^0-9]*$)")
LATEST = 0.04
UNKNOWN = 65535


def read_millimetres(tree: FileTree, frame: CapturedFrame, least: int = 0) -> DepthMap:
    """Read a 16-bit PNG of depths in millimetres, and the PNG of their confidence if there is one.

    Args:
        tree: The files.
        frame: The frame, which has a depth map.
        least: Least confidence of a depth that is used.

    Raises:
        OSError: If a file is missing or damaged.
    """
    assert frame.depth is not None
    depth = _decoded(tree, frame.depth)
    if frame.confidence is None:
        return DepthMap(np.divide(depth, 1000.0, dtype=np.float32), depth > 0)
    confidence = _decoded(tree, frame.confidence)
    if confidence.shape != depth.shape:
        raise OSError(0, f"{frame.confidence} is of another size")
    return DepthMap(np.divide(depth, 1000.0, dtype=np.float32), confidence >= least)


def millimetre_png(least: int) -> partial[DepthMap]:
    """Return `read_millimetres` with this least confidence."""
    return partial(read_millimetres, least=least)


def _decoded(tree: FileTree, name: str) -> NDArray[np.uint8] | NDArray[np.uint16]:
    import cv2

    data = tree.read(name)
    decodable(data)
    picture = decoded_as(data, cv2.IMREAD_UNCHANGED)
    if picture is None or picture.ndim != 2 or picture.dtype not in (np.uint8, np.uint16):
        raise OSError(0, "it is no grey picture of 8 or 16 bits")
    return picture


def depth_points(
    depth: DepthMap,
    captured: CapturedFrame,
    turn: Turn,
    frame: PosedImage,
    index: int,
    limit: int,
    farthest: float,
) -> SparsePoints:
    """Take confident depths from all over an image as its tracked points.

    Args:
        depth: The depth map of the stored image.
        captured: The frame with its pose, before it is turned.
        turn: How the stored image is turned.
        frame: The frame as it is delivered.
        index: Position of the frame, which decides the sample and the ids of the points.
        limit: Largest number of points.
        farthest: Largest depth that is used [m].

    Returns:
        The points. No two frames have one in common.
    """
    camera = captured.camera
    sensor = Undistorter(camera, captured.lens) if depth.camera is None else Undistorter(depth.camera)
    in_camera, stored = sampled_points(depth, sensor, index, limit, farthest)
    if depth.camera is not None:
        stored = camera.project(in_camera)
    assert captured.T_camera_world is not None
    stored = turn.pixels(stored, camera.width, camera.height)
    return _observed(in_camera, stored, captured.T_camera_world, frame, index)


def depth_pictures(folder: Path, images: Sequence[str]) -> dict[str, str]:
    """Return the depth picture of images by name: that with the number in its name that is nearest to the image's.

    The number is the last one in a name, which may be a time stamp. It must agree within `LATEST`. Images without one
    are left out.
    """
    pictures = {number: name for name in FileTree(folder).listed() if (number := _number(name)) is not None}
    numbers, found = sorted(pictures), {}
    for image in images:
        number = _number(image)
        if number is None or not numbers:
            continue
        after = bisect_left(numbers, number)
        apart, nearest = min((abs(other - number), other) for other in numbers[max(after - 1, 0) : after + 1])
        if apart <= LATEST:
            found[image] = pictures[nearest]
    return found


def _number(name: str) -> float | None:
    found = NUMBER.search(PurePosixPath(name).stem)
    return None if found is None else float(found[0])


def points_of_picture(file: Path, frame: PosedImage, index: int, scale: float, farthest: float) -> SparsePoints:
    """Take depths from all over a depth picture, which is registered to an image, as the image's tracked points.

    Args:
        file: The picture. Its values 0 and 65535 mean that a depth is not known.
        frame: The image.
        index: Position of the frame, which decides the sample and the ids of the points.
        scale: Value of the picture for a depth of one unit of the poses.
        farthest: Largest depth that is used [units of the poses].

    Raises:
        OSError: If the picture is missing or damaged.
    """
    values = _decoded(FileTree(file.parent), file.name)
    depth = DepthMap(np.divide(values, scale, dtype=np.float32), (values > 0) & (values < UNKNOWN))
    in_camera, stored = sampled_points(depth, frame.undistorter, index, MOST_POINTS, farthest)
    return _observed(in_camera, stored, frame.T_camera_world, frame, index)


def _observed(
    in_camera: NDArray[np.float64],
    stored: NDArray[np.float64],
    T_camera_world: NDArray[np.float64],
    frame: PosedImage,
    index: int,
) -> SparsePoints:
    """Return points (N, 3) of a camera, at pixels (N, 2) of the stored image, as those of the delivered frame."""
    T_world_camera = inverse_se3(T_camera_world)
    xyz = in_camera @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    ids = index * IDS_PER_FRAME + np.arange(len(xyz), dtype=np.int64)
    return points_inside(xyz, frame.undistorter.points(stored), ids, frame.undistorter, frame.T_camera_world)


def sampled_points(
    depth: DepthMap, undistorter: Undistorter, index: int, limit: int, farthest: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Take confident depths from all over a depth map.

    Args:
        depth: The depth map.
        undistorter: Holds its camera and lens, at any size.
        index: Position of the frame, which decides the sample.
        limit: Largest number of points.
        farthest: Largest depth that is used [m].

    Returns:
        Points (N, 3) in the camera's frame, and their pixels (N, 2) at the size of the camera.
    """
    rows, columns = _sampled(depth, index, limit, farthest)
    (height, width), camera = depth.metres.shape, undistorter.raw
    pixels = np.stack([(columns + 0.5) * camera.width / width, (rows + 0.5) * camera.height / height], axis=1)
    z = depth.metres[rows, columns].astype(np.float64)
    return np.column_stack([undistorter.rays(pixels) * z[:, None], z]), pixels


def _sampled(depth: DepthMap, index: int, limit: int, farthest: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Choose pixels (N,), (N,) by row and column: one at random in each cell of a grid of at most `limit` cells."""
    import cv2

    metres = np.where(np.isfinite(depth.metres), depth.metres, 0.0).astype(np.float32)
    around = np.ones((3, 3), np.uint8)
    spread = cv2.dilate(metres, around) - cv2.erode(metres, around)
    good = depth.confident & (metres > 0) & (metres <= farthest) & (spread <= EDGE * metres)
    height, width = metres.shape
    rows, columns = np.nonzero(good)
    side = np.sqrt(height * width / limit)
    down, across = max(1, int(height / side)), max(1, int(width / side))
    cell = (rows * down // height) * across + columns * across // width
    rank = np.random.default_rng(index).random(good.shape)[rows, columns]
    order = np.lexsort((rank, cell))
    first = np.flatnonzero(np.diff(cell[order], prepend=-1))
    return rows[order][first], columns[order][first]
