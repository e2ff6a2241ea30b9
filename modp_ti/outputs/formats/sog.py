"""`.sog`, PlayCanvas's compressed splats, version 2: a zip archive of lossless WebP images and `meta.json`.

Pixel i of an image belongs to Gaussian i, row by row. Images have red, green, blue and alpha in 8 bits each.

    means_l, means_u  low and high byte of 16 bits of sign(v) log(|v| + 1), between a minimum and a maximum per axis
    scales            index of each log scale in a codebook of 256 numbers
    quats             three components, times sqrt(1/2) in 8 bits; alpha is 252 + the index of the largest of w, x, y, z
    sh0               index of each constant harmonic in a codebook; alpha is the opacity
    shN_labels        row of the palette: red + 256 green
    shN_centroids     the palette's other harmonics as indices into a codebook: a pixel per harmonic, 64 entries a row

The axes are those of 3DGS files. `model` says that the map was optimised with anti-aliasing.

Streamed SOG, the layout for large maps, version 1, is `lod-meta.json` and a folder of SOG files per chunk. A viewer
loads the chunks that it needs. `lod-meta.json` holds

    version, asset, count, counts, lodLevels    1; the program; number of Gaussians, in all and at each level
    filenames                                   `meta.json` of each chunk, as in a `.sog` file but not in an archive
    tree                                        boxes that hold boxes (`children`), or Gaussians at each level (`lods`):
                                                a chunk (`file`), and the place and number of its Gaussians there

A level with a higher number has less detail. All levels of a box show the same part of the map, and one is drawn.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.map.blocks import Boxes, extent_of
from modp_ti.files.atomic import replace_file
from modp_ti.outputs.formats.compressed_splats import morton_order, opacities, smallest_three, to_bits, unit_quaternions
from pipelines.whole.hierarchy import LEVELS, Hierarchy, Level

CODES = 256
# Rounds of Lloyd's algorithm for a codebook and for the palette.
CODE_ROUNDS, PALETTE_ROUNDS = 20, 3
# Largest palette, and the number of Gaussians per entry of a smaller one.
LARGEST_PALETTE, SHARE = 1 << 12, 16
ENTRIES_PER_ROW = 64
# Gaussians whose distances to the palette are computed at once.
BLOCK = 4096
# Number of Gaussians of a chunk of streamed SOG, about.
CHUNK = 1 << 16


def write_sog(path: str | os.PathLike[str], state: Mapping[str, NDArray]) -> None:
    """Write Gaussians, reordered so that neighbours in space are neighbours in the images.

    Args:
        path: The file.
        state: Gaussians by name, as from `GaussianField.to_numpy`.
    """
    replace_file(path, sog_bytes(state))


def sog_bytes(state: Mapping[str, NDArray]) -> bytes:
    """Return the content of a `.sog` file; see `write_sog`."""
    order = morton_order(state["position"])
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_STORED) as archive:
        # A fixed date, so that the same map gives the same file.
        for name, data in _sog_files({name: values[order] for name, values in state.items()}).items():
            archive.writestr(zipfile.ZipInfo(name), data)
    return content.getvalue()


def _sog_files(state: Mapping[str, NDArray]) -> dict[str, bytes]:
    """Return the files of a `.sog` archive by name, with the Gaussians in the order that is given."""
    count, harmonics = state["sh"].shape[:2]
    width = 4 * int(np.ceil(np.sqrt(max(count, 1)) / 4))
    height = 4 * int(np.ceil(max(count, 1) / width / 4))
    images: dict[str, NDArray[np.uint8]] = {}

    def add(name: str, *channels: NDArray[np.integer]) -> None:
        """Lay out channels (N,) or (N, C) as an image; the alpha channel is 255 where it is not given."""
        rgba = np.zeros((width * height, 4), np.uint8)
        rgba[:, 3] = 255
        table = np.column_stack(channels)
        rgba[:count, : table.shape[1]] = table
        images[name] = rgba.reshape(height, width, 4)

    position = state["position"].astype(np.float64)
    place = np.sign(position) * np.log1p(np.abs(position))
    low, high = (place.min(axis=0), place.max(axis=0)) if count else (np.zeros(3), np.zeros(3))
    steps = to_bits((place - low) / np.maximum(high - low, 1e-12), 16)
    add("means_l", steps & 255)
    add("means_u", steps >> 8)
    scale_codes, scales = codebook(state["log_scale"])
    add("scales", scales)
    largest, others = smallest_three(unit_quaternions(state))
    add("quats", to_bits(others * np.sqrt(0.5) + 0.5, 8), 252 + largest)
    constant_codes, constants = codebook(state["sh"][:, 0])
    add("sh0", constants, to_bits(opacities(state), 8))
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "MODP-Ti"},
        "count": count,
        "model": "antialiased",
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _short(scale_codes), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _short(constant_codes), "files": ["sh0.webp"]},
    }
    if harmonics > 1 and count:
        entries, labels = palette(state["sh"][:, 1:].reshape(count, -1).astype(np.float64))
        codes, indices = codebook(entries)
        add("shN_labels", labels & 255, labels >> 8)
        rows = -(-len(entries) // ENTRIES_PER_ROW)
        image = np.zeros((rows * ENTRIES_PER_ROW * (harmonics - 1), 4), np.uint8)
        image[:, 3] = 255
        image[: len(entries) * (harmonics - 1), :3] = indices.reshape(-1, 3)
        images["shN_centroids"] = image.reshape(rows, -1, 4)
        meta["shN"] = {
            "count": len(entries),
            "bands": round(harmonics**0.5) - 1,
            "codebook": _short(codes),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    content = {f"{name}.webp": _webp(image) for name, image in images.items()}
    return content | {"meta.json": json.dumps(meta, separators=(",", ":")).encode("ascii")}


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
    for name, data in _sog_files({name: values[members] for name, values in level.values.items()}).items():
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


def codebook(values: NDArray[np.floating]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Choose 256 numbers that represent many with a small squared error, by Lloyd's algorithm from their quantiles.

    Args:
        values: Any shape.

    Returns:
        The sorted codes (256,), and the index of the nearest one for every value.
    """
    flat = np.sort(values, axis=None).astype(np.float64)
    if len(flat) == 0:
        return np.zeros(CODES, np.float32), np.zeros(values.shape, np.uint8)
    # Half by quantiles and half by equal steps, so that rare extreme values are represented as well.
    codes = np.sort(np.append(np.quantile(flat, np.linspace(0, 1, CODES // 2)), np.linspace(flat[0], flat[-1], 128)))
    total = np.append(0.0, np.cumsum(flat))
    for _ in range(CODE_ROUNDS):
        edges = np.concatenate([[0], np.searchsorted(flat, (codes[1:] + codes[:-1]) / 2), [len(flat)]])
        members = np.diff(edges)
        codes = np.where(members > 0, np.diff(total[edges]) / np.maximum(members, 1), codes)
        codes = np.sort(codes)
    codes = codes.astype(np.float32)
    middles = (codes[1:].astype(np.float64) + codes[:-1]) / 2
    return codes, np.searchsorted(middles, values).astype(np.uint8)


def palette(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Choose vectors that represent many with a small squared error, by Lloyd's algorithm from halved boxes.

    Args:
        values: (N, D).

    Returns:
        The palette (K, D), and the row (N,) of the entry for every vector, which is the mean of its vectors.
    """
    import torch

    most = min(LARGEST_PALETTE, max(len(values) // SHARE, 1))
    labels = _halved(values, int(np.log2(most)))
    entries = _means(values, labels)
    vectors = torch.from_numpy(values).float()
    for _ in range(PALETTE_ROUNDS):
        table = torch.from_numpy(entries).float()
        offset = 0.5 * (table * table).sum(dim=1)
        nearest = [(offset - block @ table.T).argmin(dim=1) for block in vectors.split(BLOCK)]
        labels = np.unique(torch.cat(nearest).numpy(), return_inverse=True)[1]
        entries = _means(values, labels)
    return entries, labels


def _means(values: NDArray[np.float64], labels: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the mean (D,) of the vectors (N, D) of every label."""
    sums = np.stack([np.bincount(labels, column) for column in values.T], axis=1)
    return sums / np.bincount(labels)[:, None]


def _halved(values: NDArray[np.float64], depth: int) -> NDArray[np.int64]:
    """Group vectors (N, D) into 2^depth groups: every group is halved at the median of its widest coordinate."""
    labels = np.zeros(len(values), np.int64)
    groups = [np.arange(len(values))]
    for _ in range(depth):
        halves = []
        for members in groups:
            part = values[members]
            ordered = members[np.argsort(part[:, part.var(axis=0).argmax()], kind="stable")]
            halves += [ordered[: len(ordered) // 2], ordered[len(ordered) // 2 :]]
        groups = halves
    for label, members in enumerate(groups):
        labels[members] = label
    return labels


def _short(codes: NDArray[np.float32]) -> list[float]:
    return [float(f"{code:.6g}") for code in codes]


def _webp(image: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    content = io.BytesIO()
    Image.fromarray(image).save(content, "WEBP", lossless=True, exact=True, quality=100, method=4)
    return content.getvalue()
