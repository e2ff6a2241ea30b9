"""Keyframes, and frames between them: the views that the map is optimised on, and their state as plain arrays."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fields.frames.pose_correction import CameraRevision
from fields.frames.tracked_frame import ImageLevel, SparsePoints, TrackedFrame
from fields.geometry.se3 import camera_centres, interpolate_se3
from fields.map.keyframe import Keyframe, median_depth_of, nbytes_of
from fields.map.trajectory import Trajectory

# Distance beyond which a keyframe is of another place [scene depths].
FAR = 3.0


class RunningMedian:
    """Median of the values added so far, kept in a sorted list."""

    def __init__(self) -> None:
        self._sorted: list[float] = []

    def __len__(self) -> int:
        return len(self._sorted)

    def add(self, value: float) -> None:
        """Add a value."""
        insort(self._sorted, value)

    @property
    def value(self) -> float:
        """Median of the values; the mean of the middle two if their number is even.

        Raises:
            IndexError: If no value has been added.
        """
        middle = len(self._sorted) // 2
        if len(self._sorted) % 2:
            return self._sorted[middle]
        return 0.5 * (self._sorted[middle - 1] + self._sorted[middle])


class KeyframeStore:
    """The keyframes, and frames between them, in the order of their frames.

    The cost of the per-frame operations does not grow with the number of keyframes, except for `errors`, which takes a
    few microseconds.

    Attributes:
        trajectory: The tracked poses of all frames, those of the keyframes included.
        selected: The keyframes without the frames between them.
        latest: Place of the last of these in the store; -1 without keyframes.
        views: Number of views that are taken at one time, as in `TrackedFrame`.
        nbytes: Bytes of the keyframes' images and points.
        begins: Indices of the keyframes with which a further place begins, apart from the map so far. Steps change
            neither their poses nor their exposures, which are the identity.
    """

    def __init__(self, levels: int = 1, min_side: int = 1, trajectory: Trajectory | None = None) -> None:
        """Create an empty store.

        Args:
            levels: Number of pyramid levels that a keyframe keeps.
            min_side: Minimum side length of all levels but the first [px].
            trajectory: The tracked poses of all frames; None for a new one.
        """
        self.levels = levels
        self.min_side = min_side
        self.trajectory = Trajectory() if trajectory is None else trajectory
        self._keyframes: list[Keyframe] = []
        self.selected: list[Keyframe] = []
        self.latest = -1
        self.views = 1
        self._depths = RunningMedian()
        self.nbytes = 0
        self.begins: set[int] = set()

    def __len__(self) -> int:
        return len(self._keyframes)

    def __getitem__(self, i: int) -> Keyframe:
        return self._keyframes[i]

    def __iter__(self) -> Iterator[Keyframe]:
        return iter(self._keyframes)

    @property
    def scene_depth(self) -> float:
        """Median over the keyframes of the median depth of their tracked points, the unit of length of the settings."""
        return self._depths.value if len(self._depths) else 1.0

    @property
    def place_begins(self) -> int:
        """Index of the frame with which the latest further place began; 0 if there is none, see `begins`."""
        return max(self.begins, default=0)

    def bytes_of(self, frame: TrackedFrame) -> int:
        """Return the number of bytes that a frame would take as a keyframe."""
        return nbytes_of(self._kept(frame, self.levels), frame.points)

    def before(self, index: int, count: int) -> list[Keyframe]:
        """Return up to `count` keyframes of the same view before frame `index`, in order, without those between."""
        found: list[Keyframe] = []
        for keyframe in reversed(self.selected):
            if len(found) == count:
                break
            if keyframe.index < index and self._of_one_view(keyframe.index, index):
                found.append(keyframe)
        return found[::-1]

    def around(self, index: int, count: int) -> list[Keyframe]:
        """Return up to `count` keyframes of the same view before frame `index`, as `before`, and all that follow it."""
        first = bisect_right(self.selected, index, key=lambda keyframe: keyframe.index)
        after = [keyframe for keyframe in self.selected[first:] if self._of_one_view(keyframe.index, index)]
        return self.before(index, count) + after

    def _of_one_view(self, a: int, b: int) -> bool:
        """Whether frames a and b show one of the views that are taken at one time."""
        return (a - b) % self.views == 0

    def errors(self) -> NDArray[np.float64]:
        """Return the errors (N,) of all keyframes."""
        return np.fromiter((k.error for k in self._keyframes), np.float64, len(self._keyframes))

    def sinking(self) -> NDArray[np.float64]:
        """Return log(error / best error) (N,) of all keyframes: 0 where it is the best, or none is known."""
        best = np.fromiter((k.best_error for k in self._keyframes), np.float64, len(self._keyframes))
        errors = np.maximum(self.errors(), 1e-12)
        return np.log(errors / np.clip(best, 1e-12, errors))

    def _kept(self, frame: TrackedFrame, levels: int) -> tuple[ImageLevel, ...]:
        """First `levels` levels of a frame's pyramid, except those that are smaller than `min_side`."""
        first, *others = frame.pyramid[:levels]
        return (first, *(o for o in others if min(o.camera.width, o.camera.height) >= self.min_side))

    def append(self, frame: TrackedFrame, is_between: bool = False) -> Keyframe:
        """Add a frame as a keyframe, or as one between. Its error starts at the mean of the others, the first at 1."""
        self.trajectory.add(frame)
        self.views = frame.views
        keyframe = self.view(frame, self.levels)
        keyframe.is_between = is_between
        self._keyframes.append(keyframe)
        if not is_between:
            self.selected.append(keyframe)
            self.latest = len(self._keyframes) - 1
        self.nbytes += keyframe.nbytes
        self._depths.add(keyframe.median_depth)
        return keyframe

    def revise_camera(self, revision: CameraRevision) -> None:
        """Replace the camera of all keyframes, see `Keyframe.revise_camera`."""
        revised: dict[int, NDArray[np.float32]] = {}  # vignettes, of which all keyframes mostly share one
        for keyframe in self._keyframes:
            vignette = keyframe.vignette
            if vignette is not None and id(vignette) not in revised:
                revised[id(vignette)] = revision.vignette(vignette)
            keyframe.revise_camera(revision, None if vignette is None else revised[id(vignette)])
        self.nbytes = sum(keyframe.nbytes for keyframe in self._keyframes)

    def mask(self, keyframe: Keyframe, transient: NDArray[np.uint8] | None) -> None:
        """Replace the mask of what moves in a keyframe of the store, see `Keyframe.mask`."""
        self.nbytes -= keyframe.nbytes
        keyframe.mask(transient)
        self.nbytes += keyframe.nbytes

    def move_to_disk(self, keyframes: Sequence[Keyframe], stored: Callable[[list[NDArray]], list[NDArray]]) -> None:
        """Replace the images of keyframes of the store, and their points, by the arrays that `stored` returns for them.

        Images that lie on disk already stay there. Points count in `nbytes` all the same, since a correction brings
        them back.
        """
        going = [keyframe for keyframe in keyframes if keyframe.image_bytes > 0]
        if not going:
            return
        points = [array for k in going for array in (k.points.xyz, k.points.pixels, k.points.ids)]
        here = [image.rgba for k in going for image in (*k.pyramid, *k.unmasked) if not image.on_disk]
        # The points first: their numbers have to lie at multiples of their size.
        arrays = stored([*points, *here])
        of_points, of_images = iter(arrays[: len(points)]), iter(arrays[len(points) :])

        def moved(image: ImageLevel) -> ImageLevel:
            return image if image.on_disk else ImageLevel(next(of_images), image.camera, on_disk=True)

        for keyframe in going:
            self.nbytes -= keyframe.nbytes
            keyframe.points = SparsePoints(next(of_points), next(of_points), next(of_points))
            keyframe.pyramid = tuple(map(moved, keyframe.pyramid))
            keyframe.unmasked = tuple(map(moved, keyframe.unmasked))
            keyframe.rgba = keyframe.pyramid[0].rgba
            self.nbytes += keyframe.nbytes

    def far(self, centres: NDArray[np.float64], views: Sequence[Keyframe]) -> NDArray[np.bool_]:
        """Return which of the camera centres (K, 3) are more than FAR away from each of the views."""
        distance = np.linalg.norm(centres[:, None] - centres_of(views), axis=2)
        return (distance > FAR * self.scene_depth).all(axis=1)

    def take_in_depths(self) -> None:
        """Recompute `scene_depth` after median depths have changed."""
        self._depths = RunningMedian()
        for keyframe in self._keyframes:
            self._depths.add(keyframe.median_depth)

    def view(self, frame: TrackedFrame, levels: int = 1) -> Keyframe:
        """Return a frame as a keyframe with so many pyramid levels, without adding it to the store.

        Pose and exposure are interpolated between the surrounding keyframes, see `corrected` and `exposure_at`.
        """
        return Keyframe(
            index=frame.index,
            rgba=frame.rgba,
            camera=frame.camera,
            trajectory=self.trajectory,
            T_camera_world=self.corrected(frame.index, frame.T_camera_world),
            points=frame.points,
            median_depth=median_depth_of(frame.points, frame.T_camera_world, self.scene_depth),
            error=float(self.errors().mean()) if self._keyframes else 1.0,
            depth_deviation=frame.depth_deviation,
            vignette=frame.vignette,
            exposure=self.exposure_at(frame.index),
            pyramid=self._kept(frame, levels),
        )

    def corrected(self, index: int, T_tracked: NDArray[np.float64]) -> NDArray[np.float64]:
        """Apply the refinement of the surrounding keyframes to a tracked pose T_camera_world (4, 4) (Section 3.3.3).

        The correction is interpolated by frame index between the keyframes of the same view before and after the frame.
        Outside the range of the keyframes, that of the nearest one is used. A view without keyframes stays as tracked.
        """
        if not self._keyframes:
            return np.array(T_tracked, dtype=np.float64)
        a, b, t = self._around(index)
        if not self._of_one_view(a.index, index):  # its correction has other axes
            return np.array(T_tracked, dtype=np.float64)
        if a is b:
            return a.correction @ T_tracked
        return interpolate_se3(a.correction, b.correction, t) @ T_tracked

    def exposure_at(self, index: int) -> NDArray[np.float64] | None:
        """Interpolate the exposure (3, 4) of frame `index` between the surrounding keyframes, as for poses.

        Returns None if exposure is not estimated.
        """
        if not self._keyframes:
            return None
        a, b, t = self._around(index)
        if a.exposure is None or b.exposure is None:
            return None
        return (1.0 - t) * a.exposure + t * b.exposure

    def _around(self, index: int) -> tuple[Keyframe, Keyframe, float]:
        """Keyframes of its view before and after frame `index`, and its position between; outside, twice the nearest.

        A view without keyframes takes those of any. Between two places apart, it is twice the nearest, too.
        """
        every = self._keyframes
        if self.views > 1:
            every = [each for each in every if self._of_one_view(each.index, index)] or every
        after = bisect_left(every, index, key=lambda keyframe: keyframe.index)
        if after == 0 or after == len(every):
            nearest = every[min(after, len(every) - 1)]
            return nearest, nearest, 0.0
        a, b = every[after - 1], every[after]
        if b.index in self.begins and index < b.index:
            nearest = a if index - a.index < b.index - index else b
            return nearest, nearest, 0.0
        return a, b, (index - a.index) / (b.index - a.index)


def centres_of(keyframes: Sequence[Keyframe]) -> NDArray[np.float64]:
    """Return the camera centres (K, 3) of keyframes in the world frame."""
    return camera_centres(np.array([keyframe.T_camera_world for keyframe in keyframes]))


# Scalars and small matrices of a `Keyframe`, with their shapes.
NUMBERS: dict[str, tuple[int, ...]] = {
    "index": (),
    "T_camera_world": (4, 4),
    "median_depth": (),
    "error": (),
    "best_error": (),
}
POINTS = {"xyz": 3, "pixels": 2}
NO_MASK = np.zeros((0, 0), dtype=np.uint8)


def keyframe_arrays(store: Iterable[Keyframe]) -> dict[str, NDArray]:
    """Store keyframes as arrays, without their images, which are taken from the frames again.

    Args:
        store: The keyframes.

    Returns:
        One array per field of `NUMBERS`, `exposure` and `is_between`, with one row per keyframe. The rows of `exposure`
        are NaN for keyframes without one. `points` holds the number of tracked points of each keyframe; `xyz` (P, 3),
        `pixels` (P, 2) and `ids` (P,) hold the points of all keyframes, concatenated. If anything moves, `transient`
        holds the masks of all keyframes, concatenated, and `transient_size` (N, 2) their sizes, 0 without a mask.
    """
    views = list(store)
    arrays: dict[str, NDArray] = {
        name: np.array(
            [getattr(view, name) for view in views], dtype=np.int64 if name == "index" else np.float64
        ).reshape(-1, *shape)
        for name, shape in NUMBERS.items()
    }
    unknown = np.full((3, 4), np.nan)
    exposures = [unknown if view.exposure is None else view.exposure for view in views]
    arrays["exposure"] = np.array(exposures).reshape(-1, 3, 4)
    arrays["is_between"] = np.array([view.is_between for view in views], dtype=np.int64)
    arrays["points"] = np.array([len(view.points) for view in views], dtype=np.int64)
    for name, width in POINTS.items():
        parts = [getattr(view.points, name) for view in views]
        arrays[name] = np.concatenate([*parts, np.zeros((0, width))])
    arrays["ids"] = np.concatenate([*(view.points.ids for view in views), np.zeros(0, dtype=np.int64)])
    masks = [NO_MASK if view.transient is None else view.transient for view in views]
    if any(mask.size for mask in masks):
        arrays["transient"] = np.concatenate([mask.ravel() for mask in masks])
        arrays["transient_size"] = np.array([mask.shape for mask in masks], dtype=np.int64)
    return arrays


class KeyframeRows:
    """Restores the keyframes of `keyframe_arrays` into a store, frame by frame.

    Attributes:
        rows: Row of each keyframe, by frame index.
    """

    def __init__(self, arrays: Mapping[str, NDArray]) -> None:
        self.rows = {int(index): row for row, index in enumerate(arrays["index"])}
        self._arrays = arrays
        self._first = np.append(0, np.cumsum(arrays["points"]))
        self._mask_size = arrays.get("transient_size", np.zeros((len(self.rows), 2), dtype=np.int64))
        self._masks = np.split(arrays.get("transient", NO_MASK.ravel()), np.cumsum(self._mask_size.prod(axis=1))[:-1])

    def put(self, frame: TrackedFrame, store: KeyframeStore) -> None:
        """Append the next keyframe, from its frame. Raises ValueError if the frame is not that of the next row."""
        row = len(store)
        if self.rows.get(frame.index) != row:
            raise ValueError(f"frame {frame.index} is not keyframe {row}")
        view = store.append(frame, bool(self._arrays["is_between"][row]))
        view.T_camera_world = np.array(self._arrays["T_camera_world"][row])
        for name in ("median_depth", "error", "best_error"):
            setattr(view, name, float(self._arrays[name][row]))
        exposure = self._arrays["exposure"][row]
        view.exposure = None if np.isnan(exposure).all() else np.array(exposure)
        own = slice(self._first[row], self._first[row + 1])
        view.points = SparsePoints(*(np.array(self._arrays[name][own]) for name in ("xyz", "pixels", "ids")))
        if self._masks[row].size:
            store.mask(view, self._masks[row].reshape(self._mask_size[row]))
