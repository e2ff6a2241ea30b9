"""`BlocksOnDisk`: the blocks of a map that lie on disk, and the keyframes that see them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.map.blocks import Boxes, box_of, extent_of, planes_of, seen
from fields.map.gaussians import GaussianField
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.companions.block_files import BlockError, BlockFiles, StoredBlock, records_of, state_of

# Depth up to which a view counts as seeing a block [median depths of its points]. Farther things are hidden, as a rule.
REACH = 8.0
# Number of blocks that are looked at together, which bounds the memory that this takes.
CHUNK = 256
ALL = slice(None)


@dataclass(slots=True)
class BlockOnDisk:
    """A block on disk.

    Attributes:
        number: Unique number.
        stored: Where it is.
        viewers: Places (V,) of the keyframes that see it.
        sweep: Number of the sweep in which its coverages were measured.
    """

    number: int
    stored: StoredBlock
    viewers: NDArray[np.int64]
    sweep: int


class BlocksOnDisk:
    """The blocks of a map that lie on disk, in the order in which they went there.

    A keyframe that sees a block on disk misses its Gaussians, and lies on disk as well.

    Args:
        gaussians: The resident Gaussians.
        keyframes: The keyframes of the map.
        folder: Folder for the files; None for a temporary one.

    Attributes:
        sweep: Number of the sweep in which coverages are measured, see `HiddenGaussians`.
        missing: Number of Gaussians on disk that a keyframe sees, by its index.
    """

    def __init__(self, gaussians: GaussianField, keyframes: KeyframeStore, folder: Path | None) -> None:
        self.gaussians = gaussians
        self.keyframes = keyframes
        self._files = BlockFiles(folder)
        self._blocks: dict[int, BlockOnDisk] = {}
        self._added = 0
        self._planes: list[tuple[NDArray[np.float64], float, NDArray[np.float64]]] = []  # pose, far and planes
        self.sweep = 0
        self.missing: Counter[int] = Counter()
        # Numbers, boxes and counts of the blocks in arrays, and what came and went since these were made.
        self._numbers = np.zeros(0, dtype=np.int64)
        self._boxes = Boxes.joined([])
        self._counts = np.zeros(0, dtype=np.int64)
        self._came: list[tuple[BlockOnDisk, Boxes]] = []
        self._gone: list[int] = []

    def __len__(self) -> int:
        return len(self._blocks)

    def __iter__(self) -> Iterator[BlockOnDisk]:
        return iter(list(self._blocks.values()))

    @property
    def boxes(self) -> Boxes:
        """The boxes (B,) around the blocks."""
        self._take_in()
        return self._boxes

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number (B,) of Gaussians of each block."""
        self._take_in()
        return self._counts

    def at(self, places: NDArray[np.int64]) -> list[BlockOnDisk]:
        """Return blocks by their places in the order."""
        self._take_in()
        return [self._blocks[number] for number in self._numbers[places].tolist()]

    def _take_in(self) -> None:
        """Update the arrays. Of a large map, it would take long to make them anew for every view."""
        if not (self._came or self._gone):
            return
        stays = ~np.isin(self._numbers, self._gone)
        came = [(block, box) for block, box in self._came if block.number in self._blocks]
        self._numbers = np.append(self._numbers[stays], [block.number for block, _ in came]).astype(np.int64)
        self._counts = np.append(self._counts[stays], [block.stored.count for block, _ in came]).astype(np.int64)
        self._boxes = Boxes.joined([self._boxes[stays], *(box for _, box in came)])
        self._came, self._gone = [], []

    def read(self, block: BlockOnDisk) -> NDArray[np.void]:
        """Return a copy of the records of a block.

        Raises:
            BlockError: If its file is missing or damaged. The map is then without it.
        """
        try:
            return self._files.read(block.stored)
        except BlockError:
            self.forget(block)
            raise

    def add(self, blocks: Sequence[tuple[NDArray[np.void], Boxes, NDArray[np.int64]]]) -> None:
        """Write blocks, given by records, box and places of viewers. Raises OSError, and adds none, without room."""
        if not blocks:
            return
        stored = self._files.write([records for records, _, _ in blocks])
        for place, (_, box, viewers) in zip(stored, blocks, strict=True):
            self._put(place, box, viewers, self.sweep)

    def _put(self, stored: StoredBlock, box: Boxes, viewers: NDArray[np.int64], sweep: int) -> BlockOnDisk:
        block = BlockOnDisk(self._added, stored, viewers, sweep)
        self._blocks[self._added] = block
        self._added += 1
        self._came.append((block, box))
        for place in viewers.tolist():
            self.missing[self.keyframes[place].index] += stored.count
        return block

    def store_keyframes(self, keyframes: Sequence[Keyframe]) -> None:
        """Move the images and points of keyframes to disk. Raises OSError if there is no room."""
        self.keyframes.move_to_disk(keyframes, self._files.store)
        self._files.forget_pages()

    def joined(self, count: int, parts: Iterable[Mapping[str, NDArray]]) -> dict[str, NDArray]:
        """Join arrays that come in parts, see `BlockFiles.joined`."""
        return self._files.joined(count, parts)

    def forget(self, block: BlockOnDisk) -> None:
        """Remove a block and its file."""
        del self._blocks[block.number]
        self._gone.append(block.number)
        self._files.forget(block.stored)
        for place in block.viewers.tolist():
            self.missing[self.keyframes[place].index] -= block.stored.count

    def fetch(self, blocks: Sequence[BlockOnDisk]) -> None:
        """Append the Gaussians of blocks to the resident ones, in order, and remove the blocks from here.

        Raises:
            BlockError: As in `read`.
            ValueError: If the pool is too small.
        """
        if blocks:
            records = np.concatenate([self.read(block) for block in blocks])
            measured = np.repeat([block.sweep == self.sweep for block in blocks], [b.stored.count for b in blocks])
            records["coverage"][~measured] = 0.0
            self.gaussians.extend(state_of(records))
            for block in blocks:
                self.forget(block)

    def change(self, block: BlockOnDisk, change: Callable[[int], None]) -> None:
        """Change the Gaussians of a block: `change` changes the resident ones from a place on, which are then those.

        Raises:
            BlockError: As in `read`.
            ValueError: If the pool is too small.
            OSError: If the changed block cannot be written. Its Gaussians are then resident.
        """
        first = len(self.gaussians)
        self.fetch([block])
        change(first)
        records = self.resident_records(first)
        box = _box(records)
        self.add([(records, box, self.viewers(box)[0])])
        self.gaussians.remove(np.arange(len(self.gaussians)) < first)

    def resident_records(self, first: int = 0, members: NDArray[np.int64] | slice = ALL) -> NDArray[np.void]:
        """Return the complete state of resident Gaussians, of `members` counted from place `first` on, as records."""
        state = self.gaussians.to_numpy(first) | self.gaussians.history(first)
        state["coverage"] = self.gaussians.coverages(first)
        return records_of({name: array[members] for name, array in state.items()})

    def remove_hidden(self, min_coverage: float, spared: NDArray[np.bool_]) -> None:
        """Remove Gaussians with less than this coverage in the present sweep [px], except of spared anchors (A,)."""
        measured = [block for block in self if block.sweep == self.sweep]
        for first in range(0, len(measured), CHUNK):
            smaller, gone = [], []
            for block in measured[first : first + CHUNK]:
                records = self.read(block)
                kept = records[(records["coverage"] >= min_coverage) | spared[records["anchor"]]]
                if len(kept) < len(records):
                    gone.append(block)
                    if len(kept):
                        smaller.append((kept, _box(kept), block.viewers))
            try:
                self.add(smaller)
            except OSError:  # no room on the disk: these blocks stay as they are
                continue
            for block in gone:
                self.forget(block)

    def viewers(self, boxes: Boxes) -> list[NDArray[np.int64]]:
        """Return the places of the keyframes that see each of B boxes."""
        planes, found = self._all_planes(), []
        for first in range(0, len(boxes), CHUNK):
            some = boxes[first : first + CHUNK]
            around = Boxes(some.low.min(axis=0)[None], some.high.max(axis=0)[None])
            places = np.flatnonzero(seen(planes, around))
            found += [places[sees] for sees in seen(planes[places], some).T]
        return found

    def look(self, place: int) -> None:
        """Determine which blocks a new keyframe, at this place in the store, sees."""
        keyframe = self.keyframes[place]
        if self._blocks:
            for block in self.at(np.flatnonzero(seen(planes_of_views([keyframe]), self.boxes)[0])):
                block.viewers = np.append(block.viewers, place)
                self.missing[keyframe.index] += block.stored.count

    def look_again(self) -> None:
        """Determine again which keyframes see which blocks, after their poses have changed."""
        self.missing.clear()
        for block, viewers in zip(self, self.viewers(self.boxes), strict=True):
            block.viewers = viewers
            for place in viewers.tolist():
                self.missing[self.keyframes[place].index] += block.stored.count

    def _all_planes(self) -> NDArray[np.float64]:
        """Planes (K, 6, 4) of all keyframes. Those of keyframes that have not moved are taken from the last call."""
        for place, view in enumerate(self.keyframes):
            far = REACH * view.median_depth
            if place == len(self._planes):
                self._planes.append((view.T_camera_world, far, planes_of(view.camera, view.T_camera_world, far)))
            elif self._planes[place][0] is not view.T_camera_world or self._planes[place][1] != far:
                self._planes[place] = (view.T_camera_world, far, planes_of(view.camera, view.T_camera_world, far))
        return np.array([planes for _, _, planes in self._planes]).reshape(-1, 6, 4)

    # ---- snapshots -------------------------------------------------------------------------------------------

    def state(self) -> dict[str, NDArray]:
        """Return the blocks as arrays, for `restore`. The records are memory-mapped. Raises BlockError as `read`."""
        stored = [block.stored for block in self]
        files = list(dict.fromkeys(place.path for place in stored))
        arrays = {
            "file": np.array([files.index(place.path) for place in stored], dtype=np.int64),
            "first": np.array([place.first for place in stored], dtype=np.int64),
            "count": self.counts,
            "checksum": np.array([place.checksum for place in stored], dtype=np.int64),
            "low": self.boxes.low,
            "high": self.boxes.high,
            "viewers": np.concatenate([np.zeros(0, dtype=np.int64), *(block.viewers for block in self)]),
            "viewer_counts": np.array([len(block.viewers) for block in self], dtype=np.int64),
            "images": np.array([view.index for view in self.keyframes if view.pyramid[0].on_disk], dtype=np.int64),
        }
        return arrays | {f"bytes{number}": self._files.contents(path) for number, path in enumerate(files)}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore the blocks of `state`. Keyframes, with their images on disk, have been restored before.

        Raises:
            ValueError: If blocks are damaged.
            OSError: If the blocks cannot be written.
        """
        kind = self.resident_records(len(self.gaussians)).dtype
        viewers = np.split(arrays["viewers"], np.cumsum(arrays["viewer_counts"])[:-1])
        files = np.unique(arrays["file"]).tolist()
        paths = {
            file: self._files.take(arrays[f"bytes{file}"], kind, int((arrays["file"] == file).sum())) for file in files
        }
        for block, (file, first, count, checksum) in enumerate(
            zip(*(arrays[name].tolist() for name in ("file", "first", "count", "checksum")), strict=True)
        ):
            stored = StoredBlock(paths[file], first, count, checksum)
            box = Boxes(arrays["low"][block : block + 1], arrays["high"][block : block + 1])
            self.read(self._put(stored, box, viewers[block], self.sweep - 1))


def _box(records: NDArray[np.void]) -> Boxes:
    return box_of(records["position"], extent_of(records["log_scale"]))


def planes_of_views(keyframes: Iterable[Keyframe]) -> NDArray[np.float64]:
    """Return the planes (V, 6, 4) that bound what keyframes see."""
    planes = [planes_of(view.camera, view.T_camera_world, REACH * view.median_depth) for view in keyframes]
    return np.array(planes).reshape(-1, 6, 4)
