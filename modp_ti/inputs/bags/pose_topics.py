"""Topics of poses: Odometry, PoseStamped, PoseWithCovarianceStamped and TransformStamped."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modp_ti.inputs.bags.bag import Bag
from modp_ti.inputs.bags.frame_tree import clean, pose_row, seconds
from modp_ti.inputs.bags.motion import Motion


@dataclass(frozen=True)
class PoseTopic:
    """The poses of a topic.

    Attributes:
        world: Name of the frame that the poses are in.
        body: Name of the frame that they are of; empty if the messages do not tell.
        motion: The poses T_world_body.
    """

    world: str
    body: str
    motion: Motion


def read_pose_topic(bag: Bag, topic: str) -> PoseTopic:
    """Read the poses of a topic.

    Raises:
        InputError: If the bag is damaged, or the poses are none.
    """
    rows, world, body = [], "", ""
    for _, message in bag.messages(topic):
        world, body = clean(message.header.frame_id), clean(getattr(message, "child_frame_id", ""))
        rows.append(_row(message))
    return PoseTopic(world, body, Motion.of_rows(np.array(rows).reshape(-1, 8), False, f"{bag.path}: {topic}"))


def _row(message: Any) -> list[float]:
    time = seconds(message.header.stamp)
    if message.__msgtype__ == "geometry_msgs/msg/TransformStamped":
        return pose_row(time, message.transform.translation, message.transform.rotation)
    # Odometry and PoseWithCovarianceStamped state how certain the pose is.
    pose = message.pose if message.__msgtype__ == "geometry_msgs/msg/PoseStamped" else message.pose.pose
    return pose_row(time, pose.position, pose.orientation)
