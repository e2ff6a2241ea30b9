"""Bags of real robots: their transforms agree with their poses. Skipped where the data is not there."""

from __future__ import annotations

import numpy as np
import pytest

from modp_ti.inputs.bags import Bag
from modp_ti.inputs.bags.bag import CLOUD, IMAGES, INFO
from modp_ti.inputs.bags.transforms import read_frame_tree, read_pose_topic
from tests.samples.bags import OPTICAL

pytestmark = pytest.mark.real_data


def test_the_odometry_of_a_robot_is_its_transform_from_odom(shared_data):
    bag = Bag(shared_data("captures") / "rosbag" / "nav2_turtlebot.mcap")
    tree, odometry = read_frame_tree(bag), read_pose_topic(bag, "/odom")
    assert (odometry.world, odometry.body) == ("odom", "base_link")
    times = odometry.motion.times
    by_tree = tree.at("odom", "base_link", times, 0.5)
    np.testing.assert_allclose(by_tree, odometry.motion.T_parent_child, atol=1e-9)
    assert np.ptp(odometry.motion.T_parent_child[:, :2, 3], axis=0).min() > 5  # it drives through rooms
    camera = tree.at("base_link", "oakd_rgb_camera_optical_frame", times[:1], 0.5)
    assert camera is not None
    np.testing.assert_allclose(camera[0, :3, :3], OPTICAL[:3, :3], atol=1e-9)  # it looks ahead
    bag.close()


@pytest.mark.parametrize("name", ["alltypes_mcap", "alltypes_sqlite3"])
def test_every_message_that_is_used_is_read_from_bags_of_all_types(name, shared_data):
    bag = Bag(shared_data("captures") / "rosbag" / name)
    for kind in (*IMAGES[:2], INFO, CLOUD, "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"):
        (topic,) = bag.of_types(kind)
        messages = list(bag.messages(topic))
        assert len(messages) == 2
        for place, message in messages:
            assert bag.read(topic, place).header.stamp == message.header.stamp
    bag.close()
