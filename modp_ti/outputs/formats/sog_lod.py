"""Streamed SOG, PlayCanvas's layout for large maps, version 1: `lod-meta.json` and a folder of SOG files per chunk.

A viewer loads the chunks that it needs. `lod-meta.json` holds

    version, asset, count, counts, lodLevels    1; the program; number of Gaussians, in all and at each level
    filenames                                   `meta.json` of each chunk, as in a `.sog` file but not in an archive
    tree                                        boxes that hold boxes (`children`), or Gaussians at each level (`lods`):
                                                a chunk (`file`), and the place and number of its Gaussians there

A level with a higher number has less detail. All levels of a box show the same part of the map, and one is drawn.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.map.blocks import Boxes, extent_of
from modp_ti.outputs.formats.sog import sog_files
from modp_ti.outputs.formats.splat_packing import morton_order
from pipelines.blocks.hierarchy import LEVELS, Hierarchy, Level

__all__ = ["write_sog_lod"]

# Number of Gaussians of a chunk, about.
CHUNK = 1 << 16


def write_sog_lod(folder: Path, hierarchy: Hierarchy, chunk: int = CHUNK) -> None:
    """Write a map at all its levels of detail.

    Args:
        folder: An existing folder.
        hierarchy: The map.
        chunk: Number of Gaussians of a chunk, about.
    """
    levels = [hierarchy.level(number) for number in range(LEVELS + 1)]
    boxes = _boxes(hierarchy.blocks.boxes, levels)
    leaves: list[dict[str, dict[str, int]]] = [{} for _ in range(len(boxes))]
    tree, order = _tree(boxes, leaves, np.arange(len(boxes)))
    filenames: list[str] = []
    for number, level in enumerate(levels):
        counts = level.counts[order]
        # A chunk holds the leaves whose first Gaussians lie in the same stretch of that many.
        of_leaf = (np.cumsum(counts) - counts) // chunk
        for place, part in enumerate(np.split(order, np.flatnonzero(np.diff(of_leaf)) + 1)):
            name = f"{number}_{place}"
            _write_chunk(folder / name, level, part)
            for leaf, count, end in zip(part, level.counts[part], np.cumsum(level.counts[part]), strict=True):
                leaves[leaf][str(number)] = {"file": len(filenames), "offset": int(end - count), "count": int(count)}
            filenames.append(f"{name}/meta.json")
    meta = {
        "version": 1,
        "asset": {"generator": "MODP-Ti"},
        "count": sum(map(len, levels)),
        "counts": [len(level) for level in levels],
        "lodLevels": len(levels),
        "filenames": filenames,
        "tree": tree,
    }
    (folder / "lod-meta.json").write_text(json.dumps(meta, separators=(",", ":")), encoding="ascii")


def _write_chunk(folder: Path, level: Level, blocks: NDArray[np.integer]) -> None:
    """Write the Gaussians of blocks, one block after the other."""
    places = []
    for block in blocks.tolist():
        own = level.places_in(np.array([block]))
        places.append(own[morton_order(level.values["position"][own])])
    members = np.concatenate(places)
    folder.mkdir()
    for name, data in sog_files({name: values[members] for name, values in level.values.items()}).items():
        (folder / name).write_bytes(data)


def _boxes(boxes: Boxes, levels: list[Level]) -> Boxes:
    """Return the boxes around each block's Gaussians of all levels, since merged ones may reach farther."""
    low, high = boxes.low.copy(), boxes.high.copy()
    for level in levels[1:]:
        position = level.values["position"].astype(np.float64)
        reach = extent_of(level.values["log_scale"])[:, None]
        low = np.minimum(low, np.minimum.reduceat(position - reach, level.first[:-1]))
        high = np.maximum(high, np.maximum.reduceat(position + reach, level.first[:-1]))
    return Boxes(low, high)


def _tree(boxes: Boxes, leaves: list, members: NDArray[np.integer]) -> tuple[dict[str, Any], NDArray[np.integer]]:
    """Halve blocks at the median along the axis where their centres spread most, until each is alone.

    Args:
        boxes: The box of each block.
        leaves: What a leaf of the tree holds for each block.
        members: The blocks.

    Returns:
        The tree, and the blocks in its order.
    """
    node: dict[str, Any] = {"bound": _bound(boxes[members])}
    if len(members) == 1:
        return node | {"lods": leaves[members[0]]}, members
    centre = 0.5 * (boxes.low[members] + boxes.high[members])
    ordered = members[np.argsort(centre[:, np.ptp(centre, axis=0).argmax()], kind="stable")]
    half = len(ordered) // 2
    (left, first), (right, second) = (_tree(boxes, leaves, part) for part in (ordered[:half], ordered[half:]))
    return node | {"children": [left, right]}, np.concatenate([first, second])


def _bound(boxes: Boxes) -> dict[str, list[float]]:
    """Return the box around boxes, in seven digits rounded outwards by a millionth of its size."""
    low, high = boxes.low.min(axis=0), boxes.high.max(axis=0)
    margin = 1e-6 * np.maximum(np.abs(low), np.abs(high)).max()
    return {"min": _digits(low - margin), "max": _digits(high + margin)}


def _digits(values: NDArray[np.float64]) -> list[float]:
    return [float(f"{value:.7g}") for value in values]
