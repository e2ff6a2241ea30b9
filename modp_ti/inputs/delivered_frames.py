"""The log that a run keeps of every frame that its tracker delivered, with all corrections."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from fields.frames.origin import NO_ORIGIN
from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.trajectory import Trajectory
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.tracked_points import TrackedPoints


@dataclass
class DeliveredFrames:
    """Metadata and observed points of all delivered frames, in order. Images are not kept.

    Attributes:
        index: Index of each frame, as in `TrackedFrame.index`.
        name: Image name of each frame.
        timestamp: Time of each frame [s].
        camera: Camera of each frame.
        held_out: Whether each frame is only for evaluation.
        trajectory: Tracked pose of each frame, shared with the map.
        points: Points and the frames that observed them.
        origin: Where the origin of the poses and points here lies in the world of the tracker (3,), not zero where that
            is far away; None before the first frame.
        corrections: Number of pose corrections received, and of those that moved the map.
    """

    index: list[int] = field(default_factory=list)
    name: list[str] = field(default_factory=list)
    timestamp: list[float] = field(default_factory=list)
    camera: list[PinholeCamera] = field(default_factory=list)
    held_out: list[bool] = field(default_factory=list)
    trajectory: Trajectory = field(default_factory=Trajectory)
    points: TrackedPoints = field(default_factory=TrackedPoints)
    origin: NDArray[np.float64] | None = None
    corrections: dict[str, int] = field(default_factory=lambda: {"received": 0, "moved": 0})

    def __len__(self) -> int:
        return len(self.index)

    @property
    def from_origin(self) -> NDArray[np.float64]:
        """What is added to places here for those in the world of the tracker (3,)."""
        return NO_ORIGIN if self.origin is None else self.origin

    @property
    def T_tracked(self) -> list[NDArray[np.float64]]:  # noqa: N802  # a transform is named by its ends
        """Tracked pose T_camera_world (4, 4) of each frame, with all corrections so far."""
        return [self.trajectory[index] for index in self.index]

    def add(self, frame: TrackedFrame, with_points: bool = True) -> None:
        """Record the next frame without its image.

        Args:
            frame: The next frame.
            with_points: Whether to record its point observations too.
        """
        self.index.append(frame.index)
        self.name.append(frame.name)
        self.timestamp.append(frame.timestamp)
        self.camera.append(frame.camera)
        self.held_out.append(frame.held_out)
        self.trajectory.add(frame)
        if with_points:
            self.points.add(frame)
        else:
            self.points.leave_out(frame)

    def correct(self, correction: PoseCorrection, around: Mapping[int, NDArray[np.float64]], moved: bool) -> None:
        """Apply a correction to the points and cameras. The map has applied it to the trajectory.

        Points named in the correction take the corrected positions. All others move with the world around their frames.

        Args:
            correction: The correction from the tracker.
            around: Similarity S_after_before (4, 4) of the world around each frame whose world moved, by index.
            moved: Whether the correction moved the map.
        """
        motions = {line: around[index] for line, index in enumerate(self.index) if index in around}
        self.points.correct(correction.ids, correction.xyz, motions)
        if correction.camera is not None:
            self.camera = [correction.camera.camera] * len(self)
            self.points.revise_camera(correction.camera)
        self.corrections["received"] += 1
        self.corrections["moved"] += moved

    def again(self, tracker: Tracker) -> Iterator[TrackedFrame]:
        """Read the images of the frames again. Frames have their latest tracked poses and points.

        Args:
            tracker: The tracker that delivered the frames. Those whose images it can no longer read are left out.
        """
        places, ids, xyz = {name: place for place, name in enumerate(self.name)}, self.points.ids, self.points.xyz
        for name, picture in tracker.pictures(self.name):
            place = places[name]
            rows, pixels = self.points.rows[place], self.points.pixels[place].astype(np.float64)
            points, index = SparsePoints(xyz[rows], pixels, ids[rows]), self.index[place]
            pose, held_out = self.trajectory[index], self.held_out[place]
            yield TrackedFrame(
                index,
                self.timestamp[place],
                name,
                T_camera_world=pose,
                points=points,
                held_out=held_out,
                **vars(picture),
            )


def settled(tracker: Tracker) -> Iterator[TrackedFrame]:
    """Iterate over the frames of a tracker with the poses and points that it has at its end.

    The images of a tracker that corrects poses are read twice.
    """
    if not tracker.corrects:
        for event in tracker:
            assert isinstance(event, TrackedFrame), "it corrects nothing"
            yield event
        return
    from fields.map.keyframes import KeyframeStore  # here, so that other trackers are checked without the engine
    from pipelines.corrections import revise

    log, views = DeliveredFrames(), 1
    for event in tracker:
        if isinstance(event, TrackedFrame):
            log.add(event)
            views = event.views
        else:
            log.correct(event, revise(KeyframeStore(trajectory=log.trajectory), event), moved=False)
    for frame in log.again(tracker):
        yield replace(frame, views=views)
