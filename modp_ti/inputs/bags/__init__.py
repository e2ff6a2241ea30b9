"""Bags of ROS 1 and ROS 2, read without ROS: their messages, and what poses, images and points these hold."""

from modp_ti.inputs.bags.bag import SUFFIXES, Bag, has_poses, is_bag

__all__ = ["SUFFIXES", "Bag", "has_poses", "is_bag"]
