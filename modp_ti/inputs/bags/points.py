"""The tracked points of a bag: of its clouds, or of its depth images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import IDS_PER_FRAME
from modp_ti.files.errors import FEW, InputError
from modp_ti.inputs.bags.bag import IMAGES, INFO, Bag, Place
from modp_ti.inputs.bags.messages import (
    camera_of_info,
    cloud_points,
    depth_metres,
    info_beside,
    is_compressed,
    is_depth,
    is_rectified,
    picture_size,
)
from modp_ti.inputs.bags.transforms import FrameTree, clean, seconds
from modp_ti.inputs.capture import DepthMap
from modp_ti.inputs.depth_maps import MOST_POINTS, sampled_points
from modp_ti.inputs.point_cloud import projected_points
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import PosedImage
from modp_ti.inputs.sources.undistortion import Intrinsics

MOST_CLOUD_POINTS = 500_000
# A depth image belongs to an image that was taken at most so long before or after it [s].
LARGEST_DELAY = 0.05


def world_points(bag: Bag, topic: str, tree: FrameTree, world: str, max_gap: float) -> NDArray[np.float64]:
    """Return the points (N, 3) of all clouds of a topic in the world. Points that repeat exactly are given once.

    Of more than `MOST_CLOUD_POINTS`, every n-th one of each cloud is taken.

    Args:
        bag: The bag.
        topic: The topic.
        tree: The transforms by which clouds are moved. Those of times at which they are not known are left out.
        world: Name of the frame of the points.
        max_gap: See `Motion.at`.

    Raises:
        InputError: If a cloud is damaged, or none can be moved to the world.
    """
    clouds: list[NDArray[np.float64]] = []
    frame, stride, count = "", 1, 0
    for _, message in bag.messages(topic):
        frame = clean(message.header.frame_id)
        T = tree.at(world, frame, np.array([seconds(message.header.stamp)]), max_gap)
        if T is None or not np.isfinite(T).all():
            continue
        try:
            xyz = cloud_points(message)
        except ValueError as error:
            raise InputError(f"{bag.path}: a cloud of {topic} is damaged: {error} (tracker.points)") from None
        if frame != world:
            xyz = xyz @ T[0, :3, :3].T + T[0, :3, 3]
        clouds.append(xyz[::stride])
        count += len(clouds[-1])
        while count > MOST_CLOUD_POINTS:
            clouds, stride = [cloud[::2] for cloud in clouds], 2 * stride
            count = sum(map(len, clouds))
    if not count:
        raise InputError(
            f"{bag.path}: no cloud of {topic} has points that can be moved from {frame!r} to {world!r} at its time "
            "(tracker.points)"
        )
    points = np.concatenate(clouds)
    if len(clouds) > 1:
        points = points[np.sort(np.unique(points, axis=0, return_index=True)[1])]
    return points


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


def with_depth_points(
    bag: Bag,
    topic: DepthTopic,
    T_world_sensor: NDArray[np.float64],
    frames: Sequence[PosedImage],
    times: NDArray[np.float64],
    most: int,
    farthest: float,
    deviation: float,
    progress: Progress | None = None,
) -> tuple[list[PosedImage], str]:
    """Give each frame points of the depth image that was taken nearest to it in time.

    Args:
        bag: The bag.
        topic: The topic of the depth images.
        T_world_sensor: Pose (N, 4, 4) of the sensor at the times of the depth images, NaN where it is not known.
        frames: The frames.
        times: Their times (M,) [s].
        most: Largest number of points of a frame.
        farthest: Largest depth of a point [m].
        deviation: Standard deviation of a depth, relative to it.
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
        in_sensor, _ = sampled_points(depth, undistorter, index, min(most, MOST_POINTS), farthest)
        xyz = in_sensor @ T[:3, :3].T + T[:3, 3]
        ids = index * IDS_PER_FRAME + np.arange(len(xyz), dtype=np.int64)
        points = projected_points(xyz, ids, frame.undistorter, frame.T_camera_world)
        result[index] = frame.with_points(points, deviation)
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
