"""`PosedRecording`: the images of a scene, and the poses, cameras, points and remarks that a reader has for them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints
from fields.geometry.camera import PinholeCamera
from modp_ti.files import read_json
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.multiview.triangulation import adjusted_frames, triangulated_frames
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.replay import PosedImage, ReplayedTracker, is_held_out, readable_sizes
from modp_ti.inputs.sources import Distortion, FrameReader, Intrinsics, Undistorter
from modp_ti.inputs.sources.frame_reader import MaskFolder
from modp_ti.inputs.sources.orientation import AS_STORED, Turn
from modp_ti.inputs.sources.protocol import require_intrinsics
from modp_ti.inputs.sources.undistortion import undistorter_beside

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import SourceSettings

T = TypeVar("T")

PANORAMAS = "its images see all round: set source.panorama: {projection: equirectangular}"
"""End of a message on a camera model of panoramas, which needs no intrinsics."""


@dataclass(frozen=True)
class StoredView:
    """What a file states of a stored image: its camera, its lens, and its pose T_camera_world (4, 4)."""

    camera: PinholeCamera
    lens: Distortion
    T_camera_world: NDArray[np.float64]


class PosedRecording:
    """The images of a scene, to which a reader gives poses and then points.

    Args:
        source: Settings of the images, which are opened.
        progress: Called while points are triangulated.

    Attributes:
        images: The image source.
        source: Its settings.
        progress: The callback.
        notes: Remarks for the user, to which readers append.
        masks: Masks that the reader's file names; None if it names none.
        frames: The images with a pose, in the source's order.
    """

    def __init__(self, source: SourceSettings, progress: Progress | None = None) -> None:
        self.source = source
        self.images = open_source(source)
        self.notes: list[str] = []
        self.masks: MaskFolder | None = None
        self.frames: list[PosedImage] = []
        self.progress = progress

    @property
    def selected(self) -> Sequence[str]:
        """Names of the images that source.start/stop/step select, in order; of panoramas, the whole images."""
        return self.images.whole.selected(self.source.start, self.source.stop, self.source.step)

    def matched(self, entries: Iterable[tuple[str, T]], origin: Path, shown: str, what: str) -> dict[str, T]:
        """Match the entries of a file with the selected images, by the names in the file.

        Args:
            entries: Name of the image in the file, and content of each entry.
            origin: The file.
            shown: Name of the file in remarks.
            what: What the entries are called, for messages.

        Returns:
            The content of the entry of each image that has one, in the source's order.

        Raises:
            InputError: If two entries have the same image, or none has a selected one.
        """
        stated, contents = zip(*entries, strict=True)
        names, remark = self.images.whole.find_all(stated)
        wanted = self._entry_of_each(stated, names, origin, what)
        absent = [name for number, name in enumerate(stated) if number not in wanted.values()]
        if not wanted:
            raise InputError(
                f"{origin}: none of its {len(absent)} {what} is in {self.images.path}: the first is {absent[0]}, there "
                f"is {self.images.whole.names[0]}; check source.path, or name the images as {Path(shown).name} does"
            )
        self.notes += [f"{shown}: {remark}"] if remark else []
        self.notes += [f"{len(absent)} {what} of {shown} are not in {self.images.path}: skipped"] if absent else []
        found = {name: contents[wanted[name]] for name in self.selected if name in wanted}
        self.note_missing(found, shown)
        return found

    def _entry_of_each(
        self, stated: Sequence[str], names: Sequence[str | None], origin: Path, what: str
    ) -> dict[str, int]:
        """Return the number of the entry of each image.

        Of several with the same image by the ends of their names, as of the folders of two cameras, it is that whose
        folders are also those of the image.
        """
        numbers: dict[str, list[int]] = {}
        for number, name in enumerate(names):
            if name is not None:
                numbers.setdefault(name, []).append(number)
        if all(len(same) == 1 for same in numbers.values()):
            return {name: same[0] for name, same in numbers.items()}
        fits = [0 if name is None else _common_end(stated[n], self.images.path / name) for n, name in enumerate(names)]
        best = max(fits)
        chosen = {name: [n for n in same if fits[n] == best] for name, same in numbers.items()}
        for name, same in numbers.items():
            if len(same) > 1 and len(chosen[name]) != 1:
                pair = " and ".join(f"{n} ({stated[n]})" for n in same[:2])
                raise InputError(
                    f"{origin}: {what} {pair} are both the image {name}; give source.path the folder from which their "
                    "names start, or the folder of one of them by its name"
                )
        return {name: same[0] for name, same in chosen.items() if same}

    def note_missing(self, posed: Mapping[str, object], origin: str) -> None:
        """Remark on selected images without a pose.

        Raises:
            InputError: If none has one.
        """
        missing = [name for name in self.selected if name not in posed]
        if not posed:
            raise InputError(f"{origin}: has no pose for any of the {len(missing)} selected frames ({missing[0]}, ...)")
        if missing:
            self.notes.append(
                f"{len(missing)} of {len(missing) + len(posed)} images have no pose in {origin}: skipped (the first: "
                f"{missing[0]})"
            )

    def pose(
        self,
        poses: Mapping[str, NDArray[np.float64]],
        intrinsics: Intrinsics | None = None,
        origin: str = "source.intrinsics",
    ) -> None:
        """Set the poses of images of one camera. Each panorama gives a frame of each of its faces.

        Args:
            poses: T_camera_world (4, 4) by image name, in the source's order.
            intrinsics: The camera; that of the image source if None.
            origin: Origin of the camera, for error messages.

        Raises:
            InputError: If the camera is unknown; or an image, a mask or the vignette does not match it.
            UnreadableImageError: If more than a share `FEW` of the images are unreadable.
        """
        undistorter = (intrinsics or require_intrinsics(self.images)).undistorter(self.images.scale)
        frames = []
        for name, T_rig_world in poses.items():
            views = zip(self.images.views(name), self.images.mounts, strict=True)
            frames += [PosedImage(view, undistorter, T_view_rig @ T_rig_world) for view, T_view_rig in views]
        self._begin(frames, origin)

    def pose_stored(self, views: Mapping[str, StoredView], origin: str, upright: bool = False) -> list[Turn]:
        """Set camera and pose of each image, as a file states them.

        COLMAP, instant-ngp, nerfstudio and phones ignore EXIF orientations, so that their cameras, poses and pixels are
        those of the stored images. They are turned with the images.

        Args:
            views: What the file states of each image, in the source's order.
            origin: The file, for messages.
            upright: Whether the cameras are known to be of the images turned as EXIF says. Otherwise their sizes tell.

        Returns:
            How each image is turned.

        Raises:
            InputError: As for `pose`, or if EXIF mirrors an image, with which no pose could be turned.
        """
        undistorters: dict[tuple[PinholeCamera, Distortion], Undistorter] = {}
        frames, turns = [], []
        for name, view in views.items():
            turn = AS_STORED if upright else self._turn_of(name, view.camera, origin)
            key = turn.camera(view.camera, view.lens)
            if key not in undistorters:
                first = next(iter(undistorters.values()), None)
                undistorters[key] = undistorter_beside(first, *key, self.images.scale)
            frames.append(PosedImage(name, undistorters[key], turn.T_turned_stored @ view.T_camera_world))
            turns.append(turn)
        if any(turn != AS_STORED for turn in turns):
            self.notes.append(
                f"the cameras and poses of {origin} are of the images as they are stored, and are turned with them"
            )
        raw = {(each.raw.width, each.raw.height) for each in undistorters.values()}
        if len(raw) > 1:
            sizes = dict.fromkeys(f"{each.camera.width}x{each.camera.height}" for each in undistorters.values())
            self.notes.append(f"the images have {len(raw)} sizes: they are mapped at {', '.join(sizes)}")
        self._begin(frames, origin)
        return turns

    def _turn_of(self, name: str, camera: PinholeCamera, origin: str) -> Turn:
        """Return the turn from the camera of a file to the delivered image; none where it is that of the latter."""
        turn = self.images.turn(name)
        if turn == AS_STORED:
            return turn
        try:
            delivered = self.images.size(name)
        except UnreadableImageError:  # counted with all damaged images
            return turn
        if (camera.width, camera.height) == delivered != turn.size(*delivered):
            return AS_STORED
        if turn.mirrored:
            raise InputError(
                f"{self.images.path / name}: its EXIF orientation mirrors the image, but the camera in {origin} is of "
                "the image as it is stored: remove the orientation from the files (exiftool -Orientation= FILES)"
            )
        return turn

    def _begin(self, frames: list[PosedImage], origin: str) -> None:
        """Check, by the headers alone, that images, masks and vignette match the cameras of the frames."""
        cameras = {frame.name: frame.undistorter for frame in frames}
        for name, size in readable_sizes(self.images, list(cameras)):
            raw = cameras[name].raw
            if size != (raw.width, raw.height):
                raise InputError(f"{self.images.path / name}: {_mismatch(size, raw, origin)}")
        self._reader = FrameReader(self.images, self.source, self.masks)
        self._reader.require_fitting(cameras.items())
        self.frames = frames

    def add_points(self, points_of: Callable[[PosedImage], SparsePoints], depth_deviation: float | None = None) -> bool:
        """Give each frame the points that a function returns for it. Returns whether any frame has one."""
        self.frames = [frame.with_points(points_of(frame), depth_deviation) for frame in self.frames]
        return any(len(frame.points) for frame in self.frames)

    def triangulate(self) -> None:
        """Track features and triangulate them with the poses, view by view of a rig: the faces of one side are a video.

        Held-out frames have no influence on the points.
        """
        order = np.argsort(np.arange(len(self.frames)) % len(self.images.mounts), kind="stable")
        frames = [self.frames[i] for i in order]
        found = triangulated_frames(self.images, frames, self._solves[order], self.progress)
        self.frames = [found[i] for i in np.argsort(order)]

    def adjust(self) -> None:
        """Bundle adjust the poses together with triangulated points."""
        self.frames, note = adjusted_frames(self.images, self.frames, self._solves, self.progress)
        self.notes.append(note)

    @property
    def _solves(self) -> NDArray[np.bool_]:
        """Whether each frame (F,) may take part in triangulation: not those that are held out."""
        return np.array([not is_held_out(index, self.source) for index in range(len(self.frames))])

    def tracker(self) -> ReplayedTracker:
        """Return the tracker that delivers the frames."""
        return ReplayedTracker(self._reader, self.frames, self.notes)


def read_entries(
    file: Path, key: str, image: str, what: str
) -> tuple[dict[str, Any], list[tuple[str, dict[str, Any]]]]:
    """Read a JSON file whose list under `key` has an entry for each image.

    Args:
        file: The file.
        key: Key of the list, in the plural.
        image: Key of an entry that names its image.
        what: Description of the file, for error messages.

    Returns:
        The content of the file, and the image name and content of each entry.

    Raises:
        InputError: If the file is not JSON, or lacks the list or an image name.
    """
    data = read_json(file, "tracker.path")
    entries = data.get(key) if isinstance(data, dict) else None
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{file}: holds no list of `{key}`; it is not {what}")
    for number, entry in enumerate(entries):
        if not isinstance(entry, dict) or not isinstance(entry.get(image), str):
            raise InputError(f"{file}: {key[:-1]} {number} has no `{image}`")
    return data, [(entry[image], entry) for entry in entries]


def _common_end(stated: str, file: Path) -> int:
    """Return how many of the last parts of two paths are the same."""
    pairs = zip(reversed(PurePosixPath(stated.replace("\\", "/")).parts), reversed(file.absolute().parts), strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def _mismatch(size: tuple[int, int], raw: PinholeCamera, origin: str) -> str:
    """Describe an image of another size than its camera, and how to mend it."""
    width, height = size
    advice = "give source.path the images that belong to these intrinsics"
    ratio = width / raw.width
    if (width, height) == (raw.height, raw.width):
        advice = "the image lies on its side: give the intrinsics of the upright image"
    elif abs(ratio * raw.height - height) <= 1.0:
        smaller = f" and set source.scale: {ratio:.4g}" if ratio < 1 else ""
        advice = f"the image is the same view at {ratio:.4g} of the size: {advice}{smaller}"
        advice += f", or multiply the intrinsics and the size in {origin} by {ratio:.4g}"
    return f"is {width}x{height}, its camera in {origin} is {raw.width}x{raw.height}; {advice}"
