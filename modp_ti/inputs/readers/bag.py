"""Kind `bag`: poses, points and images of a ROS bag."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fields.geometry.se3 import inverse_poses
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.inputs.bags.bag import CLOUD, POSES, SUFFIXES, has_poses, is_bag
from modp_ti.inputs.bags.points import DepthTopic, depth_topics, read_depth_topic, with_depth_points, world_points
from modp_ti.inputs.bags.transforms import FrameTree, clean, read_frame_tree, read_pose_topic
from modp_ti.inputs.point_cloud import spread_points
from modp_ti.inputs.posed_recording import PosedRecording
from modp_ti.inputs.reader import PosesSettings
from modp_ti.inputs.sources.protocol import ImageSource

if TYPE_CHECKING:
    from modp_ti.inputs.bags.images import BagImages
    from modp_ti.inputs.source_settings import SourceSettings


class BagSettings(PosesSettings):
    """The poses of a ROS bag."""

    in_metres: ClassVar[bool] = True
    file_suffixes: ClassVar[Sequence[str]] = SUFFIXES

    kind: Literal["bag"] = "bag"
    pose: str | None = Field(
        default=None,
        description="topic of the poses (Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped), or `tf` "
        "for the transforms alone; empty: the first topic of these types, or else `tf`",
    )
    world: str | None = Field(
        default=None, description="frame of the map; empty: that of the poses, or the root of the transforms"
    )
    body: str | None = Field(
        default=None,
        description="frame that the poses are of; empty: the messages' child_frame_id, or else that of the camera",
    )
    camera: str | None = Field(
        default=None,
        description="frame of the camera, with z forward and y down (the optical frame); empty: that of the images",
    )
    max_gap: float = Field(
        default=0.5,
        gt=0,
        description="largest time [s] between two poses, or two transforms, between which an image may lie",
    )
    points: str | None = Field(
        default=None,
        description="topic of the points (PointCloud2), or `none` to triangulate them; empty: the first such topic, if "
        "there is one",
    )
    depth: str | None = Field(
        default=None,
        description="topic of depth images (Image of encoding 16UC1 or 32FC1, or compressedDepth), each of which gives "
        "the image that was taken with it up to 400 points, or `none`; empty: the first such topic whose camera is "
        "known, unless `points` is set",
    )
    max_depth: float = Field(default=5.0, gt=0, description="largest depth [m] of a point of a depth image")
    depth_deviation: float = Field(default=0.02, gt=0, description="standard deviation of such a depth [share of it]")
    max_points: int = Field(
        default=2000, ge=10, description="largest number of points of a frame that are taken from the clouds"
    )
    adjust: bool = Field(
        default=False,
        description="bundle adjust the poses with triangulated points before the first frame: for poses with errors of "
        "more than a pixel",
    )

    def add_poses(self, recording: PosedRecording) -> None:
        """Give the images that were taken while the poses of a bag are known these poses.

        The poses are those of the topic `pose`, moved to the camera by the transforms of the bag, or those transforms
        alone. The points are those of the depth images of `depth`, or of all clouds of `points`; without, they are
        triangulated.
        """
        from modp_ti.inputs.bags.images import BagImages

        if not isinstance(recording.images, BagImages):
            raise InputError(f"{recording.source.path}: tracker.kind: bag reads the poses of a ROS bag: this is none")
        _pose(recording, recording.images, self)

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        return tree.is_folder and is_bag(tree.path)

    @classmethod
    def open_images(cls, path: Path, source: SourceSettings) -> ImageSource:
        """Open the images of a topic."""
        from modp_ti.inputs.bags.images import BagImages

        return BagImages(path, source.bag, source.stop, calibrated=not source.intrinsics.given)

    @classmethod
    def poses_of(cls, path: Path) -> Path | None:
        return path if has_poses(path) else None


def _pose(recording: PosedRecording, images: BagImages, tracker: BagSettings) -> None:
    tree = read_frame_tree(images.bag)
    notes = recording.notes
    world = _with_poses(images, tracker, tree, notes)
    camera = clean(tracker.camera or images.frame_id)
    names = recording.selected
    times = np.array([images.timestamp(name) for name in names])
    T_world_camera = tree.at(world, camera, times, tracker.max_gap)
    if T_world_camera is None:
        frames = ", ".join(tree.frames) or "none"
        raise InputError(
            f"{images.path}: no transform leads from {camera!r}, the frame of the images, to {world!r}; the frames are "
            f"{frames}: set tracker.camera to the camera's frame, tracker.body to that of the poses, or tracker.kind: "
            "klt to track the images alone"
        )
    known = np.isfinite(T_world_camera[:, 0, 3])
    if not known.any():
        raise InputError(
            f"{images.path}: the images, of {times.min():.6f} to {times.max():.6f} s, were all taken before or after "
            f"the poses, or in gaps of more than {tracker.max_gap:g} s between them (tracker.max_gap)"
        )
    if not known.all():
        first = names[int(np.argmin(known))]
        notes.append(
            f"{len(names) - known.sum()} of {len(names)} images were taken before or after the poses, or in a gap of "
            f"more than {tracker.max_gap:g} s between them: skipped (the first: {first})"
        )
    T_camera_world = inverse_poses(T_world_camera[known])
    named = [name for name, its in zip(names, known, strict=True) if its]
    recording.pose(dict(zip(named, T_camera_world, strict=True)))
    if tracker.adjust:
        recording.adjust()
        return
    if _add_depths(recording, images, tracker, tree, world, times[known]):
        return
    xyz = _points(images, tracker, tree, world, notes)
    if xyz is None:
        recording.triangulate()
        return
    numbers = np.arange(len(xyz))
    if not recording.add_points(lambda frame: spread_points(xyz, numbers, frame, tracker.max_points)):
        raise InputError(
            f"{images.path}: none of the {len(xyz)} points is seen by any of the {len(recording.frames)} images: set "
            "tracker.points: none to have points triangulated"
        )


def _with_poses(images: BagImages, tracker: BagSettings, tree: FrameTree, notes: list[str]) -> str:
    """Add the poses of the chosen topic to the transforms, and return the world's frame. Adds remarks for the user."""
    bag, topics = images.bag, images.bag.pose_topics
    if tracker.pose is not None and tracker.pose != "tf":
        topics = [bag.chosen(tracker.pose, POSES, "tracker.pose")]
    camera = clean(tracker.camera or images.frame_id)
    if tracker.pose == "tf" or not topics:
        world = clean(tracker.world or tree.root(camera))
        if not tree.moves:
            raise InputError(f"{bag.path}: holds no poses: set tracker.kind: klt to track the images alone")
        notes.append(f"{bag.path}: poses of {camera} in {world} by the tf tree")
        return world
    topic, *others = topics
    poses = read_pose_topic(bag, topic)
    body = clean(tracker.body or poses.body or camera)
    tree.add(poses.world, body, poses.motion)
    world = clean(tracker.world or poses.world)
    choice = f"; there are also {', '.join(others)} (tracker.pose)" if others else ""
    taken = "" if tracker.body or poses.body else f", which does not say of what: of {camera} (tracker.body)"
    notes.append(f"{bag.path}: poses of {body} in {poses.world} by {topic}{taken}{choice}")
    return world


def _add_depths(
    recording: PosedRecording,
    images: BagImages,
    tracker: BagSettings,
    tree: FrameTree,
    world: str,
    times: NDArray[np.float64],
) -> bool:
    """Give the frames points of depth images. Returns whether the bag has some that can be used."""
    if tracker.depth == "none" or (tracker.depth is None and tracker.points is not None):
        return False
    try:
        topic = _depth_topic(images, tracker.depth, recording.notes)
        if topic is None:
            return False
        T_world_sensor = tree.at(world, topic.frame, topic.times, tracker.max_gap)
        if T_world_sensor is None:
            raise InputError(
                f"{images.path}: no transform leads from {topic.frame!r}, the frame of {topic.name}, to {world!r}"
            )
        limits = tracker.max_points, tracker.max_depth, tracker.depth_deviation
        recording.frames, note = with_depth_points(
            images.bag, topic, T_world_sensor, recording.frames, times, *limits, recording.progress
        )
    except InputError as error:
        if tracker.depth is not None:
            raise
        recording.notes.append(f"{error}: depth images are not used")
        return False
    recording.notes.append(note)
    return True


def _depth_topic(images: BagImages, given: str | None, notes: list[str]) -> DepthTopic | None:
    """Return the given topic of depth images, or else the first one whose camera is known."""
    names = depth_topics(images.bag)
    if given is not None and given not in names:
        raise InputError(
            f"{images.path}: has no depth images at {given}; there is {', '.join(names) or 'none'} (tracker.depth)"
        )
    for name in names if given is None else [given]:
        topic = read_depth_topic(images.bag, name, images.frame_id, images.intrinsics)
        if topic is not None:
            others = ", ".join(other for other in names if other != name)
            notes.extend([f"{images.path}: there are also depth images of {others} (tracker.depth)"] if others else [])
            return topic
    if given is not None:
        raise InputError(f"{images.path}: no CameraInfo belongs to the depth images of {given} (tracker.depth)")
    return None


def _points(
    images: BagImages, tracker: BagSettings, tree: FrameTree, world: str, notes: list[str]
) -> NDArray[np.float64] | None:
    """Return the points (N, 3) of the chosen topic of clouds, None if there is none. Adds remarks for the user."""
    if tracker.points == "none":
        return None
    if tracker.points is not None:
        topics = [images.bag.chosen(tracker.points, (CLOUD,), "tracker.points")]
    else:
        topics = images.bag.of_types(CLOUD)
    if not topics:
        return None
    topic, *others = topics
    try:
        xyz = world_points(images.bag, topic, tree, world, tracker.max_gap)
    except InputError as error:
        if tracker.points is not None:
            raise
        notes.append(f"{error}: points are triangulated instead")
        return None
    choice = f"; there are also {', '.join(others)} (tracker.points)" if others else ""
    notes.append(f"{images.path}: {len(xyz)} points of {topic}{choice}")
    return xyz
