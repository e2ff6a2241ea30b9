"""`Paging`: moves blocks of the map to disk when there is no room for more, and back when a view sees them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.map.blocks import Blocks, Boxes, divide, extent_of, seen
from fields.map.gaussians import GaussianField
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore, centres_of
from fields.runtime.process import give_back_heap
from pipelines.companions.away import CHUNK, BlocksOnDisk, planes_of_views
from pipelines.companions.companion import Companion
from pipelines.safeguards import OBSERVATION, MemoryBudget
from pipelines.settings import MappingSettings

# Side of a block [scene depths]. An image is about one scene depth wide where most of it lies.
SIDE = 0.125
# Share of a limit that is used after blocks have gone to disk, so that they go rarely.
KEPT = 0.9
# Width from which on blocks always stay in memory [scene depths]. Blocks hold Gaussians of about one size.
SKY = 3.0
# Size of a group of keyframes: Gaussians that they see together, over the number that fit. In smaller groups, fewer
# blocks are moved, but what two groups see is optimised for one after the other, which is worse than for both at once.
TOGETHER = 1.5
# Share of the Gaussians in sight of the latest keyframe that another one may miss and still be drawn as a view. Views
# around the camera are drawn in this way, and those of distant places are not.
MISSING = 0.5
# Bytes of voxels that a new Gaussian takes, rounded up.
VOXELS_EACH = 128


class Paging(Companion):
    """Keeps the resident part of a map within its limits, `max_gaussians` and `memory`.

    Space is divided into cubes. When a new keyframe lacks room, the blocks that it does not see go to disk, the
    farthest first, with the complete state of their Gaussians. Before a view is rendered, the blocks that it sees come
    back. Keyframes of distant places are not drawn as views while the map grows. The voxels of the whole map stay in
    memory, so that no Gaussian is added where one lies on disk; where none is resident, they rest.

    What is moved depends on the map alone, so that runs are reproducible. A map within its limits is not touched.

    Args:
        gaussians: The resident Gaussians.
        keyframes: The keyframes of the map.
        budget: Memory budget of the map.
        settings: Settings of the mapping.
        folder: Folder for the files; None for a temporary one.

    Attributes:
        away: The blocks on disk.
        group: Group (K,) of each keyframe after `plan`.
        most_missing: Number of Gaussians on disk that a keyframe may see and still be drawn as a view.
        problem: Why nothing can go to disk any more; None if it can.
    """

    def __init__(
        self,
        gaussians: GaussianField,
        keyframes: KeyframeStore,
        budget: MemoryBudget,
        settings: MappingSettings,
        folder: Path | None = None,
    ) -> None:
        self.gaussians = gaussians
        self.keyframes = keyframes
        self.budget = budget
        self.settings = settings
        self.away = BlocksOnDisk(gaussians, keyframes, folder)
        self.group = np.zeros(0, dtype=np.int64)
        self.most_missing = 0
        self.problem: str | None = None

    @property
    def count(self) -> int:
        """Number of Gaussians of the whole map."""
        return len(self.gaussians) + int(self.away.counts.sum())

    def to_numpy(self) -> dict[str, NDArray]:
        """Return the values of the whole map, the resident Gaussians first, see `GaussianField.to_numpy`.

        Those of a map that is partly on disk are memory-mapped, if the disk has room for them.

        Raises:
            BlockError: If a block's file is missing or damaged. The map is then without it.
        """
        return self._joined(self.gaussians.to_numpy())

    def placed(self) -> tuple[NDArray[np.floating], NDArray[np.int32]]:
        """Return the position (N, 3) and the anchor (N,) of every Gaussian of the whole map, as `to_numpy` does."""
        whole = self._joined({"position": self.gaussians.to_numpy()["position"], "anchor": self.gaussians.anchors()})
        return whole["position"], whole["anchor"]

    def _joined(self, here: dict[str, NDArray]) -> dict[str, NDArray]:
        """Return arrays of the resident Gaussians, followed by the same ones of the blocks on disk."""
        if len(self.away) == 0:
            return here
        try:
            joined = self.away.joined(self.count, self._parts(here))
            give_back_heap()
            return joined
        except OSError:  # no room on the disk
            parts = list(self._parts(here))
            return {name: np.concatenate([part[name] for part in parts]) for name in here}

    def _parts(self, here: dict[str, NDArray]) -> Iterator[dict[str, NDArray]]:
        """Yield arrays of the resident Gaussians, then those of a few blocks on disk at a time."""
        yield here
        blocks = list(self.away)
        for first in range(0, len(blocks), CHUNK):
            records = np.concatenate([self.away.read(block) for block in blocks[first : first + CHUNK]])
            yield {name: np.ascontiguousarray(records[name]) for name in here}

    # ---- while the map grows ---------------------------------------------------------------------------------

    def before_frame(self, frame: TrackedFrame, is_wanted: bool) -> None:
        """Make room for what a frame adds, and bring in what it sees if it should become a keyframe.

        Raises BlockError as `to_numpy`.
        """
        most = self.settings.densify.pixels_of(frame.camera.width, frame.camera.height, candidates=1.0)
        self._prepare(frame, round(most) if is_wanted else 0, bring=is_wanted)

    def after_view(self, place: int) -> None:
        self.away.look(place)

    def near(self) -> NDArray[np.int64]:
        """Return the places (M,) of the keyframes around the latest one, of which views are drawn.

        They miss at most `most_missing` Gaussians. If parts of the map lie on disk, or it has places apart, they are
        also at most FAR away. Otherwise, what is in memory of an earlier place would be drawn as often as the present
        one.
        """
        store = self.keyframes
        missing = np.fromiter((self.away.missing[view.index] for view in store), np.int64, len(store))
        places = np.flatnonzero(missing <= self.most_missing)
        if (missing.any() or store.begins) and len(places) and store.latest >= 0:
            centres = centres_of([store[place] for place in places.tolist()])
            places = places[~store.far(centres, [store[store.latest]])]
        return places

    def _prepare(self, frame: TrackedFrame, pixels: int, bring: bool) -> None:
        """Make room for `pixels` Gaussians, and those at the points of a frame; `bring` in what it sees first."""
        if len(self.keyframes) == 0:
            return
        added = pixels + len(frame.points)
        nbytes = added * VOXELS_EACH + len(frame.points) * OBSERVATION + self.keyframes.bytes_of(frame)
        if min(self._spare(nbytes)) < added or (bring and len(self.away)):
            view = self.keyframes.view(frame)
            if not bring:
                self._make_room([view], added, nbytes)
                return
            self._bring([view], added, nbytes)
            position = self.gaussians.to_numpy()["position"].astype(np.float64)
            in_sight = seen(planes_of_views([view]), Boxes(position, position))
            self.most_missing = round(MISSING * np.count_nonzero(in_sight))

    def rewrite(self, change: Callable[[int], None]) -> None:
        """Change the Gaussians of all blocks on disk, one block after the other.

        `change` changes the resident Gaussians from a place on. Raises BlockError as `to_numpy`.
        """
        for block in self.away:
            self._make_room([], block.stored.count, 0)
            try:
                self.away.change(block, change)
            except OSError as error:
                self.problem = f"blocks of the map cannot be kept on disk: {error.strerror}"
        self.away.look_again()

    # ---- the finished map ------------------------------------------------------------------------------------

    def plan(self) -> None:
        """Group the keyframes in order, so that few blocks have to be moved between the views of a group."""
        self.group = np.zeros(len(self.keyframes), dtype=np.int64)
        if len(self.away):
            blocks = self._divided()
            boxes = Boxes.joined([blocks.boxes, self.away.boxes])
            sees = (seen(planes[None], boxes)[0] for planes in planes_of_views(self.keyframes))
            counts = np.concatenate([blocks.counts, self.away.counts])
            room = len(self.gaussians) + min(self._spare(0))
            self.group = grouped(sees, counts, round(TOGETHER * room))

    def groups(self) -> list[NDArray[np.int64]]:
        """Return the places of each group's keyframes. A map without blocks on disk is one group."""
        if len(self.group) != len(self.keyframes):
            self.plan()
        return [np.flatnonzero(self.group == number) for number in range(self.group.max(initial=-1) + 1)]

    def before_views(self, views: Sequence[Keyframe]) -> None:
        """Bring in what keyframes see, before they are rendered. Raises BlockError as `to_numpy`."""
        if any(self.away.missing[view.index] for view in views):
            self._bring(views, 0, 0)

    # ---- room ------------------------------------------------------------------------------------------------

    def _divided(self) -> Blocks:
        values = self.gaussians.to_numpy()
        return divide(values["position"], extent_of(values["log_scale"]), SIDE * self.keyframes.scene_depth)

    def _spare(self, nbytes: int, share: float = 1.0) -> tuple[float, float]:
        """Number of Gaussians for which a share of the pool, and of the memory beside `nbytes`, has room."""
        memory = np.inf
        if self.budget.limit is not None:
            memory = (share * self.budget.limit - self.budget.held() - nbytes) / self.gaussians.bytes_each
        return share * self.gaussians.capacity - len(self.gaussians), memory

    def _bring(self, views: Sequence[Keyframe], gaussians: int, nbytes: int) -> None:
        """Bring in the blocks that views see, the nearest to the first view first, as far as there is room.

        Args:
            views: The views.
            gaussians: Number of further Gaussians to make room for.
            nbytes: Number of other bytes to make room for.
        """
        boxes, counts = self.away.boxes, self.away.counts
        wanted = np.flatnonzero(seen(planes_of_views(views), boxes).any(axis=0))
        wanted = wanted[_by_distance(boxes[wanted], views[0])]
        nbytes += int(counts[wanted].sum()) * VOXELS_EACH  # of voxels that rest
        self._make_room(views, int(counts[wanted].sum()) + gaussians, nbytes)
        fit = np.cumsum(counts[wanted]) + gaussians <= min(self._spare(nbytes))
        self.away.fetch(self.away.at(wanted[fit]))

    def _make_room(self, views: Sequence[Keyframe], gaussians: int, nbytes: int) -> None:
        """Move blocks to disk that no view sees, the farthest from the first view first, until there is room.

        Args:
            views: The views. Without any, every block may go.
            gaussians: Number of Gaussians to make room for.
            nbytes: Number of other bytes to make room for.
        """
        if self.problem is not None or min(self._spare(nbytes)) >= gaussians:
            return
        blocks = self._divided()
        # Wide Gaussians are the sky, which a view sees at any distance.
        sky = (blocks.boxes.high - blocks.boxes.low).min(axis=1) > SKY * self.keyframes.scene_depth
        free = np.flatnonzero(~seen(planes_of_views(views), blocks.boxes).any(axis=0) & ~sky)
        if views:
            free = free[_by_distance(blocks.boxes[free], views[0])[::-1]]
        pool, memory = self._spare(nbytes, KEPT)
        if memory == np.inf:
            # The number of blocks that go is known beforehand; who sees the others does not matter.
            free = free[: 1 + int(np.searchsorted(pool + np.cumsum(blocks.counts[free]), gaussians))]
        gone = np.zeros(len(self.gaussians), dtype=bool)
        going, images = [], set()
        for block, sees in zip(free.tolist(), self.away.viewers(blocks.boxes[free]), strict=True):
            if min(pool, memory) >= gaussians:
                break
            members = blocks.of(block)
            freed = sum(self.keyframes[place].image_bytes for place in set(sees.tolist()) - images)
            pool, memory = pool + len(members), memory + len(members) + freed / self.gaussians.bytes_each
            images.update(sees.tolist())
            gone[members] = True
            going.append((members, blocks.boxes[block : block + 1], sees))
        try:
            self._store(going)
            self.gaussians.remove(~gone)
            if self.budget.voxels is not None:
                self.budget.voxels.rest(self.gaussians.to_numpy()["position"])
            self.away.store_keyframes([self.keyframes[place] for place in sorted(images)])
            give_back_heap()
        except OSError as error:
            self.problem = f"blocks of the map cannot be kept on disk: {error.strerror}"

    def _store(self, going: Sequence[tuple[NDArray[np.int64], Boxes, NDArray[np.int64]]]) -> None:
        """Write resident blocks to disk, given as members, box and viewers. Raises OSError if there is no room."""
        if going:
            records = self.away.resident_records(members=np.concatenate([members for members, _, _ in going]))
            ends = np.cumsum([len(members) for members, _, _ in going])
            parts = np.split(records, ends[:-1])
            self.away.add([(part, box, sees) for part, (_, box, sees) in zip(parts, going, strict=True)])


def _by_distance(boxes: Boxes, view: Keyframe) -> NDArray[np.int64]:
    """Return the order of boxes by their distance from a view's camera, the nearest first."""
    return np.argsort(boxes.distance(view.centre), kind="stable")


# Keyframes are at another place if the earlier ones of their group see at most this share of the Gaussians that they
# see. Groups are optimised one after the other, and what they share suits the last one best: a copy of redkitchen had
# 0.16 dB less when it was divided between two groups.
SHARED = 0.1


def grouped(seen: Iterable[NDArray[np.bool_]], counts: NDArray[np.int64], room: int) -> NDArray[np.int64]:
    """Group keyframes in order.

    A group ends before the keyframe with which it would see more than fits, or earlier, where it comes to a place that
    shares hardly any Gaussians with those before.

    Args:
        seen: For each of K keyframes, which blocks (B,) it sees.
        counts: Number (B,) of Gaussians of each block.
        room: Number of Gaussians that fit.

    Returns:
        Number (K,) of each keyframe's group, from 0 on. A keyframe that sees more than fits is alone.
    """
    sizes: list[int] = []  # of the groups that have ended
    rows: list[NDArray[np.bool_]] = []  # of the group that has not
    together = np.zeros(len(counts), dtype=bool)
    for row in seen:
        while rows and counts[together | row].sum() > room:
            sizes.append(_end(rows, counts))
            rows = rows[sizes[-1] :]
            together = np.any(rows, axis=0) if rows else np.zeros_like(together)
        rows.append(row)
        together |= row
    sizes += [len(rows)] if rows else []
    return np.repeat(np.arange(len(sizes)), sizes)


def _end(rows: Sequence[NDArray[np.bool_]], counts: NDArray[np.int64]) -> int:
    """Return how many of a group's keyframes (K, B) stay in it: all, or those before it comes to another place."""
    before, after = np.logical_or.accumulate(rows), np.logical_or.accumulate(rows[::-1])[::-1]
    shares = [counts[a & b].sum() / max(counts[b].sum(), 1) for a, b in zip(before[:-1], after[1:], strict=True)]
    if shares and min(shares) <= SHARED:
        return shares.index(min(shares)) + 1
    return len(rows)
