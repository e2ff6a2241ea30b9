"""Base classes of the readers in `modp_ti.inputs.readers`: the settings of a kind of tracker, and how it is read."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, model_validator

from fields.frames.tracked_frame import SparsePoints
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import FileTree
from modp_ti.files.reading import reading
from modp_ti.inputs.depth_maps import depth_pictures, points_of_picture
from modp_ti.inputs.point_cloud import read_point_file, spread_points
from modp_ti.inputs.posed_recording import PosedRecording
from modp_ti.inputs.protocol import Progress, Tracker
from modp_ti.inputs.timed_poses import on_the_clock_of, read_trajectory_file
from pipelines.settings import StrictModel

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import Scene, SourceSettings
    from modp_ti.inputs.sources import ImageSource


class TrackerSettings(StrictModel):
    """Base class of readers: the `tracker` section of a scene, with what other sections depend on, and its reading.

    The docstring of a kind is its description in the reference of settings. A kind whose poses belong to recordings of
    one layout reads the images of these too: it defines `recognises` and `open_images`.
    """

    # Each kind narrows it to one literal. Declared here so that it is the first key in `config.yaml` and in the docs.
    kind: Any

    needs_source: ClassVar[bool] = True
    """Whether the images come from `source`; other trackers provide their own."""
    brings_cameras: ClassVar[bool] = False
    """Whether the tracker provides the camera of every image, so that `source.intrinsics` must be empty."""
    follows_streams: ClassVar[bool] = False
    """Whether the tracker works on a live `source.stream`, whose images are not known in advance."""
    is_live: ClassVar[bool] = False
    """Whether the frames arrive from another program and cannot be read again after the run."""
    in_metres: ClassVar[bool] = False
    """Whether the poses are in metres, as those of phones, depth cameras and robots, and so the map is."""
    places_panoramas: ClassVar[bool] = False
    """Whether the tracker has poses of images that see all round, which `source.panorama` cuts into faces."""
    source_kind: ClassVar[str] = ""
    """The `source.kind` of the recordings whose images this kind reads, if it is another name than `kind`."""
    file_suffixes: ClassVar[Sequence[str]] = ()
    """Suffixes of the files that are such recordings, whatever they hold."""
    pose_files: ClassVar[Sequence[str]] = ()
    """Patterns of the files of poses in a folder of images that has no scene file, in the order of preference."""

    @abstractmethod
    def open(self, scene: Scene, progress: Progress | None = None) -> Tracker:
        """Open the tracker of a scene whose `tracker` is this. See `modp_ti.open_tracker`."""

    def second_choice(self, images: int) -> TrackerSettings | None:
        """The tracker that is tried on a recording of so many images where this one places few; None for none."""
        return None

    @classmethod
    def recognises(cls, tree: FileTree) -> bool:
        """Whether a folder or archive is such a recording. It must be cheap: it lists files at most."""
        return False

    @classmethod
    def open_images(cls, path: Path, source: SourceSettings) -> ImageSource:
        """Open the images of such a recording.

        Args:
            path: The file or folder.
            source: Settings of the images.

        Raises:
            InputError: If it is no such recording, or it is damaged.
        """
        raise NotImplementedError

    @classmethod
    def poses_of(cls, path: Path) -> Path | None:
        """Return what `path` of this kind is for a recording or a folder of images; the path itself if they are in it.

        None if it has no poses of this kind.
        """
        return next((file for pattern in cls.pose_files for file in path.glob(pattern)), None)


def in_a_sentence(model: type[BaseModel]) -> str:
    """Return what a model of settings is, in words for within a sentence: the first line of its docstring."""
    first = (model.__doc__ or "").partition("\n")[0].removesuffix(".")
    return first[:1].lower() + first[1:]


def kind_of(reader: type[TrackerSettings]) -> str:
    """Return the `tracker.kind` of a reader."""
    return reader.model_fields["kind"].default


class PosesSettings(TrackerSettings):
    """Base class for trackers that read the results of earlier tracking, all at once."""

    def open(self, scene: Scene, progress: Progress | None = None) -> Tracker:
        """Open the images, and give them the poses and points of `add_poses`."""
        recording = PosedRecording(self.images_of(scene.source), progress)
        try:
            self.add_poses(recording)
        except InputError:
            recording.images.close()
            raise
        return recording.tracker()

    def images_of(self, source: SourceSettings) -> SourceSettings:
        """Return the settings of the images that the poses are of."""
        return source

    @abstractmethod
    def add_poses(self, recording: PosedRecording) -> None:
        """Give the images of a recording their poses and points. Images without a pose are skipped.

        Raises:
            InputError: If a file is missing or malformed, or does not belong to the images.
        """


class RecordedSettings(PosesSettings):
    """Base class for trackers with a file of poses."""

    # Each kind describes its file and the default places in its own `description`.
    path: Path | None = None

    def found(self, source: SourceSettings, names: Sequence[str], what: str) -> Path:
        """Return the file `path`, or the first of some names in this folder or, if it is empty, near the images.

        Args:
            source: Settings of the images, in or next to whose folder the file may lie.
            names: Names of the file or patterns of them, in the order of preference.
            what: Description of the file, for error messages.

        Raises:
            InputError: If there is no such file, or there are several by one pattern.
        """
        place = source.require_path()
        if self.path is not None and not self.path.is_dir():
            if not self.path.is_file():
                raise InputError(f"{self.path}: no such file (tracker.path); it should be {what}")
            return self.path
        folders = [place, place.parent] if self.path is None else [self.path]
        for name in names:
            for folder in folders:
                found = sorted(file for file in folder.glob(name) if file.is_file())
                if len(found) > 1:
                    raise InputError(f"{folder}: holds {len(found)} files {name}: name one of them in tracker.path")
                if found:
                    return found[0]
        raise InputError(f"no {', '.join(names)} in {' or '.join(map(str, folders))}: set tracker.path to {what}")


class TimedPosesSettings(RecordedSettings):
    """Base class for trackers that match poses with images by time stamp."""

    max_difference: float = Field(
        default=0.02, gt=0, description="largest difference [s] between the times of an image and its pose"
    )
    time_offset: float = Field(
        default=0.0, description="offset [s] added to the times of the poses, if their clock differs from the images'"
    )

    def rows_at_frames(self, recording: PosedRecording, path: Path, times: NDArray[np.float64]) -> dict[str, int]:
        """Associate the selected images with poses by time.

        An image and a pose may differ by at most `max_difference`. Each is used once; the pairs nearest in time are
        matched first.

        Args:
            recording: The images.
            path: Origin of the poses, for messages.
            times: Times (N,) of the poses [s], before `time_offset` is added.

        Returns:
            The row of the pose of each matched image, by name in the source's order.

        Raises:
            InputError: If no image has a pose.
        """
        names, whole = recording.selected, recording.images.whole
        of_frames = np.array([whole.timestamp(name) for name in names])
        every = np.array([whole.timestamp(name) for name in whole.names])
        shifted, pairs, remark = on_the_clock_of(
            of_frames, every, times, self.time_offset, self.max_difference, str(path)
        )
        if len(pairs) == 0:
            raise InputError(
                f"{path}: no pose lies within {self.max_difference:g} s of a frame: its times run from "
                f"{shifted[0]:.6f} to {shifted[-1]:.6f} s, those of the frames from {of_frames.min():.6f} to "
                f"{of_frames.max():.6f} s; check source.fps, tracker.time_offset and tracker.max_difference"
            )
        rows = {str(names[int(frame)]): int(row) for frame, row in pairs}
        recording.notes += [f"the times of {path.name} {remark}"] if remark else []
        recording.note_missing(rows, path.name)
        return rows


class GivenPosesSettings(RecordedSettings):
    """Base class for trackers whose file contains poses but no points."""

    adjusts_by_default: ClassVar[bool] = False

    points: Path | None = Field(
        default=None,
        description="world points: PLY, or text with `x y z` per line; empty: features are tracked and triangulated "
        "with the poses",
    )
    adjust: bool | None = Field(
        default=None,
        description="without `points`: bundle adjust the poses with the triangulated points before the first frame. "
        "Use it for poses of another sensor or with errors of more than a pixel. Empty: false",
    )
    max_points: int = Field(
        default=2000, ge=10, description="largest number of points of a frame that are taken from `points`"
    )
    depth: Path | None = Field(
        default=None,
        description="folder of depth pictures (16 bits, one channel, registered to the images), whose depths are the "
        "tracked points; an image gets that with the number in its name that is nearest to its own",
    )
    depth_scale: float = Field(
        default=1000.0,
        gt=0,
        description="value of these pictures for a depth of 1 in the units of the poses: 5000 for TUM, 6553.5 for "
        "Replica",
    )
    max_depth: float = Field(default=5.0, gt=0, description="largest depth that is used, in these units")
    depth_deviation: float = Field(default=0.02, gt=0, description="standard deviation of a depth [share of it]")

    @property
    def adjusts(self) -> bool:
        """Whether the poses are adjusted before the first frame."""
        return self.adjusts_by_default if self.adjust is None else self.adjust

    @model_validator(mode="after")
    def _points_come_from_one_place(self) -> GivenPosesSettings:
        given = {"points": self.points, "depth": self.depth, "adjust": self.adjust or None}
        several = [f"tracker.{name}" for name, value in given.items() if value is not None]
        if len(several) > 1:
            raise ValueError(f"{several[-1]} cannot be used with {several[0]}; remove one of them")
        return self

    def give(self, recording: PosedRecording, poses: Mapping[str, NDArray[np.float64]]) -> None:
        """Set poses, and the points of the settings.

        With `points`, each frame gets the points of that file that project into it. Otherwise features are tracked and
        triangulated with the poses, and with `adjust` the poses are bundle adjusted together with these points.

        Args:
            recording: The images.
            poses: T_camera_world (4, 4) by image name, in the source's order.

        Raises:
            InputError: As for `PosedRecording.pose`, or if the point file is invalid.
        """
        recording.pose(poses)
        if self.points is not None:
            xyz, limit = read_point_file(self.points), self.max_points
            numbers = np.arange(len(xyz))
            if not recording.add_points(lambda frame: spread_points(xyz, numbers, frame, limit)):
                raise InputError(
                    f"{self.points}: none of its {len(xyz)} points is seen by any of the {len(recording.frames)} "
                    "frames: points and poses must be of one world, poses camera to world (tracker.points)"
                )
        elif self.depth is not None:
            self._give_depths(recording, self.depth)
        elif self.adjusts:
            recording.adjust()
        else:
            recording.triangulate()

    def _give_depths(self, recording: PosedRecording, folder: Path) -> None:
        """Give each frame points of its depth picture."""
        pictures, points = depth_pictures(folder, [frame.name for frame in recording.frames]), []
        for index, frame in enumerate(recording.frames):
            if frame.name not in pictures:
                points.append(SparsePoints())
                continue
            file = folder / pictures[frame.name]
            with reading(file, " (tracker.depth)"):
                points.append(points_of_picture(file, frame, index, self.depth_scale, self.max_depth))
        given = iter(points)
        if not recording.add_points(lambda _: next(given), self.depth_deviation):
            raise InputError(
                f"{folder}: none of its depth pictures has the number of an image and a depth of at most "
                f"{self.max_depth:g}: check tracker.depth, and tracker.depth_scale ({self.depth_scale:g})"
            )
        recording.notes.append(f"{folder}: points of depth pictures for {len(pictures)} of {len(points)} images")

    def give_by_number(
        self,
        recording: PosedRecording,
        file: Path,
        poses: Mapping[int, NDArray[np.float64]],
        number: Callable[[str], int] | None = None,
    ) -> None:
        """Set the poses of images by their numbers, as `give` does.

        Args:
            recording: The images.
            file: Origin of the poses.
            poses: T_camera_world (4, 4) by number.
            number: Returns the number of an image by its name; None for its position in the source, from 0.

        Raises:
            InputError: If no selected image has a pose, or as for `give`.
        """
        numbers = {name: (number or recording.images.whole.position)(name) for name in recording.selected}
        posed = {name: poses[n] for name, n in numbers.items() if n in poses}
        recording.note_missing(posed, file.name)
        most, there = max(poses), len(recording.images.whole)
        if number is None and most >= there:
            recording.notes.append(
                f"{file.name} has poses of {most + 1} images, there are {there}: do they belong together?"
            )
        self.give(recording, posed)


class TrajectorySettings(TimedPosesSettings, GivenPosesSettings):
    """Base class for trackers whose file is a trajectory in TUM's format."""

    places_panoramas: ClassVar[bool] = True

    def give_trajectory(self, recording: PosedRecording, file: Path) -> None:
        """Set the poses of a trajectory in TUM's format, as `give` does.

        Raises:
            InputError: If it is malformed, its times do not match the images, or as for `give`.
        """
        trajectory = read_trajectory_file(file)
        if trajectory.left_out:
            recording.notes.append(
                f"{trajectory.left_out} of {trajectory.left_out + len(trajectory.times)} lines of {file.name} hold NaN "
                "or a time out of order: left out"
            )
        rows = self.rows_at_frames(recording, file, trajectory.times)
        self.give(recording, {name: trajectory.T_camera_world[row] for name, row in rows.items()})
