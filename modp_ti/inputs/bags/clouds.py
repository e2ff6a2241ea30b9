"""PointCloud2 messages as points of the world."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.files.trajectory import FARTHEST
from modp_ti.inputs.bags.bag import Bag
from modp_ti.inputs.bags.frame_tree import FrameTree, clean, seconds

# Types of the coordinates by PointField's `datatype`.
FLOATS = {7: "f4", 8: "f8"}
MOST_POINTS = 500_000


def cloud_points(message: Any) -> NDArray[np.float64]:
    """Return the finite points (N, 3) of a PointCloud2 message, in its own frame.

    Raises:
        ValueError: If it has no coordinates of float32 or float64, or fewer bytes than it states.
    """
    order = ">" if message.is_bigendian else "<"
    fields = {field.name: field for field in message.fields}
    if not all(axis in fields and fields[axis].datatype in FLOATS for axis in "xyz"):
        raise ValueError("it has no fields x, y and z of float32 or float64")
    step, row, width, height = message.point_step, message.row_step, message.width, message.height
    formats = [order + FLOATS[fields[axis].datatype] for axis in "xyz"]
    offsets = [fields[axis].offset for axis in "xyz"]
    end = max(offset + np.dtype(form).itemsize for offset, form in zip(offsets, formats, strict=True))
    if step < end or row < width * step or message.data.size < row * height:
        raise ValueError(f"it holds {message.data.size} bytes, in rows of {row}, for {width}x{height} points of {step}")
    packed = np.ascontiguousarray(message.data[: row * height].reshape(height, row)[:, : width * step])
    record = np.dtype({"names": list("xyz"), "formats": formats, "offsets": offsets, "itemsize": step})
    points = packed.reshape(-1).view(record) if packed.size else np.zeros(0, record)
    with np.errstate(all="ignore"):  # converting a signalling NaN to float64 warns
        xyz = np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=1)
    return xyz[(np.abs(xyz) <= FARTHEST).all(axis=1)]


def world_points(bag: Bag, topic: str, tree: FrameTree, world: str, max_gap: float) -> NDArray[np.float64]:
    """Return the points (N, 3) of all clouds of a topic in the world. Points that repeat exactly are given once.

    Of more than `MOST_POINTS`, every n-th one of each cloud is taken.

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
        while count > MOST_POINTS:
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
