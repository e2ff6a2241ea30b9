"""Depth images of a bag, and the tracked points that are taken from them."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import IDS_PER_FRAME, SparsePoints
from modp_ti.files.errors import FEW, InputError
from modp_ti.inputs.bags.bag import IMAGES, INFO, Bag, Place
from modp_ti.inputs.bags.camera_info import camera_of_info, info_beside, is_rectified
from modp_ti.inputs.bags.frame_tree import clean, seconds
from modp_ti.inputs.bags.pictures import is_compressed, is_depth, picture_size, stored_values
from modp_ti.inputs.capture import DepthMap
from modp_ti.inputs.depth_maps import sampled_points
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import PosedImage, points_inside
from modp_ti.inputs.sources.image_header import why_undecodable
from modp_ti.inputs.sources.image_pixels import decoded_as
from modp_ti.inputs.sources.intrinsics import Intrinsics

if TYPE_CHECKING:
    from modp_ti.inputs.readers.bag import BagSettings

# A depth image belongs to an image that was taken at most so long before or after it [s].
LARGEST_DELAY = 0.05
# Largest number of points of a frame. No two frames have one in common, so that more say little of the others.
MOST = 400
# Before the PNG of a compressed depth image: its format, and two parameters of inverse depths.
HEADER = struct.Struct("<iff")


@dataclass(frozen=True)
class DepthTopic:
    """A topic of depth images.

    Attributes:
        name: The topic.
        frame: Name of the sensor's optical frame.
        camera: Camera of the images.
        times: Times (N,) of the images [s], increasing.
        places: Where they are.
    """

    name: str
    frame: str
    camera: Intrinsics
    times: NDArray[np.float64]
    places: Sequence[Place]


def depth_topics(bag: Bag) -> list[str]:
    """Return the topics of depth images, by name. Raises InputError if the bag is damaged."""
    return [topic for topic in bag.of_types(*IMAGES) if is_depth(bag.first(topic))]


def read_depth_topic(bag: Bag, topic: str, frame: str, camera: Intrinsics | None) -> DepthTopic | None:
    """Find the depth images of a topic, and their camera.

    Args:
        bag: The bag.
        topic: The topic.
        frame: Name of the frame of the images in colour.
        camera: Camera of the images in colour, which is taken for depth images of the same frame and size that have no
            CameraInfo of their own.

    Returns:
        The topic; None if its camera is not known.

    Raises:
        InputError: If the bag is damaged.
    """
    first = bag.first(topic)
    size, its_frame = picture_size(first) if not is_compressed(first) else None, clean(first.header.frame_id)
    its = None
    infos = {info: bag.first(info) for info in bag.of_types(INFO)}
    beside = info_beside(topic, [info for info, message in infos.items() if _is_of(message, its_frame, size)])
    if beside is not None:
        its = camera_of_info(infos[beside], is_rectified(topic), f"{bag.path}: {beside}")
    elif camera is not None and its_frame == frame and size in (None, (camera.camera.width, camera.camera.height)):
        its = camera
    if its is None:
        return None
    found = sorted(((seconds(m.header.stamp), place) for place, m in bag.messages(topic)), key=lambda each: each[0])
    return DepthTopic(topic, its_frame, its, np.array([time for time, _ in found]), [place for _, place in found])


def _is_of(info: Any, frame: str, size: tuple[int, int] | None) -> bool:
    """Whether a CameraInfo describes images of this frame and size, None for any."""
    return clean(info.header.frame_id) == frame and size in (None, (info.width, info.height))


def depth_metres(message: Any) -> NDArray[np.float32]:
    """Return the depths (H, W) [m] of an image message; 0 or NaN where they are unknown.

    Raises:
        ValueError: If it is damaged, or holds no depths.
    """
    if not is_compressed(message):
        if message.encoding == "32FC1":
            return stored_values(message, "f4")
        return np.divide(stored_values(message, "u2"), 1000.0, dtype=np.float32)
    import cv2

    data = message.data.tobytes()
    head, png = data[: HEADER.size], data[HEADER.size :]
    reason = "it is cut off" if not png else why_undecodable(png)
    stored = None if reason is not None else decoded_as(png, cv2.IMREAD_UNCHANGED)
    if stored is None or stored.ndim != 2 or stored.dtype != np.uint16:
        raise ValueError(reason or "it holds no grey picture of 16 bits")
    if not message.format.startswith("32FC1"):
        return np.divide(stored, 1000.0, dtype=np.float32)
    _, scale, offset = HEADER.unpack(head)
    with np.errstate(all="ignore"):  # parameters of a damaged message
        return np.where(stored > 0, np.float32(scale) / (stored.astype(np.float32) - np.float32(offset)), np.float32(0))


def with_depth_points(
    bag: Bag,
    topic: DepthTopic,
    T_world_sensor: NDArray[np.float64],
    frames: Sequence[PosedImage],
    times: NDArray[np.float64],
    tracker: BagSettings,
    progress: Progress | None = None,
) -> tuple[list[PosedImage], str]:
    """Give each frame points of the depth image that was taken nearest to it in time.

    Args:
        bag: The bag.
        topic: The topic of the depth images.
        T_world_sensor: Pose (N, 4, 4) of the sensor at the times of the depth images, NaN where it is not known.
        frames: The frames.
        times: Their times (M,) [s].
        tracker: How many points a frame gets, and how far away.
        progress: Called with what is done, how much of it and of how much.

    Returns:
        The frames, and a remark for the user.

    Raises:
        InputError: If more than a few depth images are damaged, or no frame has a point.
    """
    result, damaged = list(frames), []
    undistorter = topic.camera.undistorter(1.0)
    for index, (frame, time) in enumerate(zip(frames, times, strict=True)):
        nearest = int(np.argmin(np.abs(topic.times - time)))
        T = T_world_sensor[nearest]
        if abs(topic.times[nearest] - time) > LARGEST_DELAY or not np.isfinite(T).all():
            continue
        try:
            metres = depth_metres(bag.read(topic.name, topic.places[nearest]))
        except ValueError as error:
            damaged.append(f"{bag.path}: unreadable image of {topic.name}: {error}")
            continue
        depth = DepthMap(metres, metres > 0)
        in_sensor, _ = sampled_points(depth, undistorter, index, min(tracker.max_points, MOST), tracker.max_depth)
        result[index] = frame.with_points(_seen(in_sensor @ T[:3, :3].T + T[:3, 3], frame, index))
        if progress is not None:
            progress("reading depths", index + 1, len(frames))
    if len(damaged) > FEW * len(frames):
        raise InputError(damaged[0])
    used = sum(len(frame.points) > 0 for frame in result)
    if not used:
        raise InputError(
            f"{bag.path}: no image sees a depth of {topic.name} that was taken within {LARGEST_DELAY:g} s of it"
        )
    bad = f"; {len(damaged)} are damaged and left out (the first: {damaged[0]})" if damaged else ""
    return result, f"{bag.path}: points of the depth images of {topic.name} for {used} of {len(frames)} images{bad}"


def _seen(xyz: NDArray[np.float64], frame: PosedImage, index: int) -> SparsePoints:
    """Return the points that lie inside the image. No two frames have one in common."""
    in_camera = xyz @ frame.T_camera_world[:3, :3].T + frame.T_camera_world[:3, 3]
    before = in_camera[:, 2] > 0
    pixels = frame.undistorter.camera.project(in_camera[before])
    ids = index * IDS_PER_FRAME + np.arange(len(pixels), dtype=np.int64)
    return points_inside(xyz[before], pixels, ids, frame.undistorter, frame.T_camera_world)
