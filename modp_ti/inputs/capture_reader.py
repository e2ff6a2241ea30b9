"""Base classes of the readers of captures: recordings of phones, robots and data sets that bring cameras and poses."""

from __future__ import annotations

import io
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fields.frames.tracked_frame import SparsePoints
from modp_ti.files import reading
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.files.file_tree import SETTING, FileTree, open_tree
from modp_ti.inputs.capture import Capture, CapturedFrame
from modp_ti.inputs.depth_maps import MOST_POINTS, depth_points
from modp_ti.inputs.posed_recording import PosedRecording, StoredView
from modp_ti.inputs.reader import PosesSettings, in_a_sentence, kind_of
from modp_ti.inputs.replay import Unreadable
from modp_ti.inputs.sources.image_folder import ListedImages
from modp_ti.inputs.sources.orientation import Turn
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.sources.undistortion import Intrinsics, both_valid
from modp_ti.inputs.sources.video_file import VideoFile

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import SourceSettings


class CaptureSettings(PosesSettings):
    """Base class for captures, whose cameras and poses come with the images of `source.path`.

    A kind defines `holds`, `recognises` and `read`.
    """

    brings_cameras: ClassVar[bool] = True
    in_metres: ClassVar[bool] = True
    holds: ClassVar[str]
    """What such a capture holds, for error messages."""

    adjust: bool = Field(
        default=False,
        description="bundle adjust the poses with triangulated points before the first frame: for poses with errors of "
        "more than a pixel",
    )

    @classmethod
    @abstractmethod
    def read(cls, tree: FileTree) -> Capture:
        """Read the cameras, poses and names of the frames of a recording that `recognises` knows.

        Raises:
            InputError: If it is malformed.
        """

    @classmethod
    def poses_of(cls, path: Path) -> Path | None:
        return path

    @classmethod
    def open_images(cls, path: Path, source: SourceSettings) -> ImageSource:
        """Open the images of a capture. Their camera is that of the first, for trackers that track them themselves."""
        capture = _capture(cls, path)
        if not capture.frames:
            raise InputError(f"{path}: has no frame that could be used")
        first = capture.frames[0]
        if not capture.video:
            images: ImageSource = _CapturedImages(capture)
            images.intrinsics = Intrinsics(first.camera, first.lens)
            return images
        images = VideoFile(capture.tree.path / capture.video, source.fps, source.stop)
        count, posed = len(images.names), len(capture.frames)
        size = images.frame_size
        frames = [
            replace(frame, image=name, camera=frame.camera.resized(*size))
            for frame, name in zip(capture.frames, images.names, strict=False)
        ]
        for note in capture.notes:
            images.add_note(note)
        if count < posed and source.stop is None:
            images.add_note(
                f"{capture.video} has {count} frames, {capture.origin} {posed} rows: the last rows are left out"
            )
        images.capture = replace(capture, frames=frames)
        images.intrinsics = Intrinsics(frames[0].camera, first.lens)
        return images

    def images_of(self, source: SourceSettings) -> SourceSettings:
        """Return the settings with the kind of the capture: both are one."""
        if source.kind not in ("auto", self.kind):
            raise InputError(
                f"{source.path}: source.kind: {source.kind} has no poses of tracker.kind: {self.kind}: leave "
                "source.kind out"
            )
        return source.model_copy(update={"kind": self.kind})

    def add_poses(self, recording: PosedRecording) -> None:
        """Give images their cameras and poses. Points are those of the depth maps, or are triangulated."""
        capture = recording.images.capture
        assert capture is not None, "it opens captures"
        origin = str(capture.tree.path / capture.origin)
        found = {frame.image: frame for frame in capture.frames}
        posed = {
            name: (frame, StoredView(frame.camera, frame.lens, frame.T_camera_world))
            for name in recording.selected
            if (frame := found.get(name)) is not None and frame.T_camera_world is not None
        }
        if not posed:
            raise InputError(
                f"{origin}: has no pose for any of the selected frames, or is missing: tracker.kind=klt tracks the "
                "images alone"
            )
        recording.note_missing(posed, capture.origin)
        turns = recording.pose_stored({name: view for name, (_, view) in posed.items()}, origin)
        if self.adjust:
            recording.adjust()
        elif not self._gives_depths(recording, capture, [frame for frame, _ in posed.values()], turns):
            recording.triangulate()

    def _gives_depths(
        self, recording: PosedRecording, capture: Capture, captured: Sequence[CapturedFrame], turns: Sequence[Turn]
    ) -> bool:
        """Give the frames points of their depth maps. Returns whether any frame has one."""
        return False


class DepthCaptureSettings(CaptureSettings):
    """Base class for captures with depth maps, whose confident depths are the tracked points."""

    depth: bool = Field(
        default=True,
        description="take the tracked points from the depth maps, where there are some; false, and with `adjust`: "
        "triangulate them",
    )
    max_points: int = Field(
        default=MOST_POINTS, ge=10, description="largest number of points of a frame from its depth map"
    )
    max_depth: float = Field(default=5.0, gt=0, description="largest depth [m] that is used")
    depth_deviation: float = Field(default=0.02, gt=0, description="standard deviation of a depth [share of it]")

    def _gives_depths(
        self, recording: PosedRecording, capture: Capture, captured: Sequence[CapturedFrame], turns: Sequence[Turn]
    ) -> bool:
        """Damaged maps are left out, up to a share `FEW` of the frames."""
        if not self.depth or capture.read_depth is None:
            return False
        points, damaged = [], Unreadable()
        for index, (stored, turn, frame) in enumerate(zip(captured, turns, recording.frames, strict=True)):
            points.append(SparsePoints())
            if stored.depth is None:
                continue
            try:
                depth = capture.read_depth(capture.tree, stored)
            except OSError as error:
                where = f"{capture.tree.path / stored.depth}: unreadable depth map: {error.strerror or error}"
                advice = "copy the capture again, or set tracker.depth: false"
                damaged.add(stored.depth, UnreadableImageError(f"{where}; {advice}"), len(captured))
                continue
            points[-1] = depth_points(depth, stored, turn, frame, index, self.max_points, self.max_depth)
        if damaged:
            recording.notes.append(damaged.note(len(captured)))
        given = iter(points)
        return recording.add_points(lambda _: next(given), self.depth_deviation)


def _capture(reader: type[CaptureSettings], path: Path) -> Capture:
    """Read a capture of a kind. The archive stays open for its images."""
    if not path.exists():
        raise InputError(f"{path}: no such capture (source.path)")
    trees = open_tree(path)
    tree = next((tree for tree in trees if reader.recognises(tree)), None)
    try:
        if tree is None:
            raise InputError(f"{path}: is no capture of kind {kind_of(reader)}, which holds {reader.holds}{SETTING}")
        with reading(tree.path, SETTING):
            capture = reader.read(tree)
        return replace(capture, notes=[f"{tree.path}: is {in_a_sentence(reader)}", *capture.notes])
    except InputError:
        trees[0].close()
        raise


class _CapturedImages(ListedImages):
    """The images of a capture in files, in a folder or an archive."""

    def __init__(self, capture: Capture) -> None:
        frames = capture.frames
        super().__init__(
            capture.tree.path, [frame.image for frame in frames], [frame.time for frame in frames], notes=capture.notes
        )
        self.capture = self._capture = capture

    def _open(self, name: str) -> BinaryIO:
        return io.BytesIO(self._content(name))

    def _content(self, name: str) -> bytes:
        return self._capture.tree.read(name)

    def valid(self, name: str) -> NDArray[np.bool_] | None:
        border = self._capture.border
        seen = super().valid(name)
        if not border:
            return seen
        width, height = self.size(name)
        mask = np.zeros((height, width), dtype=bool)
        mask[border:-border, border:-border] = True
        return both_valid(mask, seen)

    def close(self) -> None:
        self._capture.tree.close()
