"""A map of any size: `Hierarchy`, its levels of detail, and `ShownMap`, the part that a view sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3, matrices_from_unit_quaternions, quaternions_from_matrices
from fields.map.blocks import Blocks, divide, extent_of, planes_of, seen
from fields.map.gaussians import GaussianField
from fields.runtime.process import give_back_heap, give_back_pages

# Number of levels below the map itself. Each has cells of twice the side of the one above.
LEVELS = 4
# Number of Gaussians of a surface in a cell of the first level, about. A block is as large as a cell of the last one.
IN_FIRST_CELL = 8
# Number of Gaussians that are merged at once.
BATCH = 1 << 18
# Sizes of cells in the image that are tried, one after the other [px].
TOLERANCES = (0.0, *np.geomspace(0.5, 2048.0, 49).tolist())


@dataclass(frozen=True)
class Level:
    """A map at one level of detail.

    Attributes:
        values: Gaussians by name, as from `GaussianField.to_numpy`.
        places: Places of the Gaussians in `values`, in the order of the blocks.
        first: Place (B + 1,) of each block's first Gaussian in `places`.
    """

    values: Mapping[str, NDArray]
    places: NDArray[np.int64]
    first: NDArray[np.int64]

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number (B,) of Gaussians in each block."""
        return np.diff(self.first)

    def __len__(self) -> int:
        return len(self.places)

    def places_in(self, blocks: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the places in `values` of the Gaussians of blocks, in the order that is given."""
        count = self.counts[blocks]
        start = np.repeat(self.first[blocks] - np.append(0, np.cumsum(count)[:-1]), count)
        return self.places[start + np.arange(len(start))]


class Hierarchy:
    """Divides a map into blocks, and merges Gaussians for each level when it is first asked for.

    Level 0 is the map. At level k, the Gaussians of each cell of side `side * 2^(k - 1)` are one, see `merged`. A block
    has the side of a cell of the last level, and more where its Gaussians are larger, see `divide`.

    Args:
        values: The map, by name as from `GaussianField.to_numpy`.

    Attributes:
        blocks: The blocks, with boxes around the Gaussians of level 0.
        side: Side of the cells of level 1 [scene units].
    """

    def __init__(self, values: Mapping[str, NDArray]) -> None:
        self.side = side_of(values["position"], IN_FIRST_CELL)
        self.blocks = divide(values["position"], extent_of(values["log_scale"]), self.side * 2 ** (LEVELS - 1))
        self._levels = [Level(values, self.blocks.members, self.blocks.first)]

    def level(self, number: int) -> Level:
        """Return the map at a level, 0 to LEVELS. Coarser ones are computed when they are first asked for."""
        while len(self._levels) <= number:
            self._levels.append(self._merged(self.side * 2 ** (len(self._levels) - 1)))
        return self._levels[number]

    def levels_for(
        self, seen: NDArray[np.integer], eye: NDArray[np.float64], focal: float, most: int
    ) -> NDArray[np.int64]:
        """Choose the level of each block such that at most so many Gaussians are drawn.

        A block at a distance d is drawn at the coarsest level whose cells are at most t pixels wide at d. The smallest
        tolerance t is taken with which all blocks fit; it is 0 if they do at level 0. If they do not fit at the last
        level, the nearest are drawn.

        Args:
            seen: Blocks (S,) to draw.
            eye: Camera centre (3,).
            focal: Focal length [px].
            most: Number of Gaussians.

        Returns:
            The level (S,) of each, -1 where a block is left out.
        """
        distance = self.blocks.boxes[seen].distance(eye)
        for tolerance in TOLERANCES:
            cells = tolerance * distance / (focal * self.side)  # of the first level that fit into the tolerance
            level = np.clip(np.floor(np.log2(np.maximum(cells, 0.5))) + 1, 0, LEVELS).astype(np.int64)
            count = np.zeros(len(seen), dtype=np.int64)
            for number in np.unique(level).tolist():
                count[level == number] = self.level(number).counts[seen[level == number]]
            if count.sum() <= most:
                return level
        # A block around the camera, too, has to lose detail.
        nearest, count = np.argsort(distance, kind="stable"), self.level(LEVELS).counts[seen]
        level = np.full(len(seen), LEVELS)
        level[nearest[np.cumsum(count[nearest]) > most]] = -1
        return level

    def gaussians(self, blocks: NDArray[np.integer], levels: NDArray[np.integer]) -> dict[str, NDArray]:
        """Return the Gaussians of blocks (S,), each at its level (S,); see `levels_for`."""
        parts = []
        for number in range(LEVELS + 1):
            if (levels == number).any():
                level = self.level(number)
                places = level.places_in(blocks[levels == number])
                parts.append({name: array[places] for name, array in level.values.items()})
        if not parts:
            return {name: array[:0] for name, array in self.level(0).values.items()}
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def _merged(self, side: float) -> Level:
        """Merge the map in cells of this side, so many blocks at once that the memory is bounded."""
        base, parts, groups = self.level(0), [], []
        ends = np.searchsorted(base.first, np.arange(0, len(base), BATCH), side="left")
        for begin, end in zip(ends, np.append(ends[1:], len(self.blocks)), strict=True):
            places = base.places[base.first[begin] : base.first[end]]
            group = np.repeat(np.arange(begin, end), base.counts[begin:end])
            part, group = merged({name: array[places] for name, array in base.values.items()}, group, side)
            parts.append(part)
            groups.append(group)
        values = {name: np.concatenate([part[name] for part in parts]) for name in base.values}
        first = np.searchsorted(np.concatenate(groups), np.arange(len(self.blocks) + 1))
        return Level(values, np.arange(first[-1]), first)


def side_of(position: NDArray[np.floating], each: int) -> float:
    """Return the side of cubes that hold about `each` positions (N, 3) of surfaces. Outliers do not count."""
    if len(position) == 0:
        return 1.0
    span = [float(np.diff(np.quantile(axis.astype(np.float64), [0.02, 0.98]))[0]) for axis in position.T]
    return float(np.prod(np.sort(span)[1:]) * each / len(position)) ** 0.5 or 1.0


# Largest opacity of a merged Gaussian.
MOST_OPAQUE = 0.99
# Only Gaussians whose largest standard deviation is at most this share of a cell's side are merged.
LARGEST = 0.5


def merged(state: Mapping[str, NDArray], group: NDArray[np.integer], side: float) -> tuple[dict[str, NDArray], NDArray]:
    """Replace the small Gaussians of each group and cell by one that has their moments.

    A Gaussian i with covariance S_i, opacity o_i and mean m_i counts by its weight w_i = o_i a_i, where

        a_i = sqrt((tr(S_i)^2 - tr(S_i^2)) / 2)

    is proportional to the root of the mean square of the areas that it covers when seen from all directions. The merged
    Gaussian has the weighted mean m of the positions, the weighted means of all harmonics, and the covariance

        S = sum w_i (S_i + (m_i - m)(m_i - m)^T) / sum w_i

    Its opacity o = sum w_i / a keeps the total of opacity times area, up to `MOST_OPAQUE`. A Gaussian that is alone in
    its cell, or too large to be merged, stays as it is.

    Args:
        state: N Gaussians by name, as from `GaussianField.to_numpy`.
        group: Group (N,) of each Gaussian, in increasing order. Gaussians of different groups are not merged.
        side: Side of the cells [scene units]. The origin of the world is a corner of one.

    Returns:
        The M merged Gaussians, ordered by group, and their groups (M,).
    """
    position, log_scale = state["position"].astype(np.float64), state["log_scale"].astype(np.float64)
    cell = np.floor(position / side).astype(np.int64)
    # Gaussians that are too large get cells of their own: by their place plus one, where it is 0 for all others.
    alone = np.where(np.exp(log_scale.max(axis=1)) > LARGEST * side, np.arange(len(position)) + 1, 0)
    key = np.column_stack([group, cell, alone])
    order = np.lexsort(key.T[::-1])  # stable: equal cells keep their order
    changes = (np.diff(key[order], axis=0) != 0).any(axis=1)
    first = np.flatnonzero(np.concatenate([[True], changes])) if len(order) else np.zeros(0, np.int64)
    result = {name: array[order[first]] for name, array in state.items()}
    count = np.diff(np.append(first, len(order)))
    several = np.flatnonzero(count > 1)
    if len(several):
        members = order[np.repeat(count > 1, count)]
        parts = {name: array[members].astype(np.float64) for name, array in state.items()}
        begin = np.append(0, np.cumsum(count[several])[:-1])
        for name, array in _moments(parts, begin).items():
            result[name][several] = array
    return result, group[order[first]]


def _moments(state: dict[str, NDArray[np.float64]], first: NDArray[np.integer]) -> dict[str, NDArray[np.float64]]:
    """Merge consecutive runs of Gaussians, which begin at `first`."""
    q = state["quaternion"]
    R = matrices_from_unit_quaternions(q / np.linalg.norm(q, axis=1, keepdims=True))
    M = R * np.exp(state["log_scale"])[:, None, :]
    S = M @ M.transpose(0, 2, 1)
    weight = _area(S) / (1.0 + np.exp(-state["opacity_logit"]))
    count = np.diff(np.append(first, len(weight)))
    total = np.add.reduceat(weight, first)
    share = weight / np.repeat(total, count)
    mean = np.add.reduceat(share[:, None] * state["position"], first)
    offset = state["position"] - np.repeat(mean, count, axis=0)
    S = np.add.reduceat(share[:, None, None] * (S + offset[:, :, None] * offset[:, None, :]), first)
    opacity = np.minimum(total / _area(S), MOST_OPAQUE)
    variance, axes = np.linalg.eigh(S)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    return {
        "position": mean,
        "log_scale": 0.5 * np.log(np.maximum(variance, 1e-12 * variance[:, 2:])),
        "quaternion": quaternions_from_matrices(axes),
        "opacity_logit": np.log(opacity) - np.log1p(-opacity),
        "sh": np.add.reduceat(share[:, None, None] * state["sh"], first),
    }


def _area(S: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the measure (N,) of the areas of covariances (N, 3, 3); see `merged`."""
    trace = np.trace(S, axis1=1, axis2=2)
    return np.sqrt(np.maximum(0.5 * (trace**2 - np.einsum("nij,nij->n", S, S)), 1e-300))


# Number of Gaussians of a block, about.
GAUSSIANS_EACH = 50


class ShownMap:
    """Loads a map into a pool. If it does not fit, only the part that a view sees is loaded.

    If that does not fit either, far blocks are loaded with less detail, see `Hierarchy`.

    Args:
        gaussians: The pool, whose Gaussians are replaced.
        values: The map, in the form of `GaussianField.to_numpy`.

    Raises:
        ValueError: From `show`, as in `GaussianField.load`.
    """

    def __init__(self, gaussians: GaussianField, values: Mapping[str, NDArray]) -> None:
        self.gaussians = gaussians
        self.values = dict(values)
        self._blocks: Blocks | None = None
        self._hierarchy: Hierarchy | None = None
        if not self.fits:
            position, extent = self.values["position"], extent_of(self.values["log_scale"])
            give_back_pages(*self.values.values())
            # Smaller blocks than those of the hierarchy, of which views see less in vain.
            self._blocks = divide(position, extent, side_of(position, GAUSSIANS_EACH))
            give_back_pages(*self.values.values())
            give_back_heap()

    @property
    def fits(self) -> bool:
        """Whether the whole map fits into the pool, so that one call of `show` serves for all views."""
        return len(self.values["position"]) <= self.gaussians.capacity

    def show(self, camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> None:
        """Load the map, or the part of it that a view sees.

        Args:
            camera: The view's camera.
            T_camera_world: Its pose (4, 4).
        """
        blocks = self._blocks
        if blocks is None:
            self.gaussians.load(self.values)
            return
        self.gaussians.load(self._seen(blocks, camera, T_camera_world))
        give_back_pages(*self.values.values())

    def _seen(self, blocks: Blocks, camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> dict[str, NDArray]:
        """Return the Gaussians of the blocks that a view sees, or fewer that stand for them."""
        planes = planes_of(camera, T_camera_world, np.inf)[None]
        chosen = np.flatnonzero(seen(planes, blocks.boxes)[0])
        if blocks.counts[chosen].sum() <= self.gaussians.capacity:
            members = np.concatenate([np.zeros(0, dtype=np.int64), *(blocks.of(block) for block in chosen.tolist())])
            return {name: array[members] for name, array in self.values.items()}
        if self._hierarchy is None:
            self._hierarchy = Hierarchy(self.values)
        chosen = np.flatnonzero(seen(planes, self._hierarchy.blocks.boxes)[0])
        eye = inverse_se3(T_camera_world)[:3, 3]
        levels = self._hierarchy.levels_for(chosen, eye, camera.fx, self.gaussians.capacity)
        return self._hierarchy.gaussians(chosen, levels)
