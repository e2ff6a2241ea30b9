"""`.sog`, PlayCanvas's compressed splats, version 2: a zip archive of lossless WebP images and `meta.json`.

Pixel i of an image belongs to Gaussian i, row by row. Images have red, green, blue and alpha in 8 bits each.

    means_l, means_u  low and high byte of 16 bits of sign(v) log(|v| + 1), between a minimum and a maximum per axis
    scales            index of each log scale in a codebook of 256 numbers
    quats             three components, times sqrt(1/2) in 8 bits; alpha is 252 + the index of the largest of w, x, y, z
    sh0               index of each constant harmonic in a codebook; alpha is the opacity
    shN_labels        row of the palette: red + 256 green
    shN_centroids     the palette's other harmonics as indices into a codebook: a pixel per harmonic, 64 entries a row

The axes are those of 3DGS files. `model` says that the map was optimised with anti-aliasing.
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

from modp_ti.files.atomic import replace_file
from modp_ti.files.json_text import parse_json
from modp_ti.files.limits import BoundedZip, most_unpacked
from modp_ti.files.reading import reading
from modp_ti.inputs.sources.image_bounds import why_undecodable
from modp_ti.outputs.formats.splat_packing import (
    logits,
    morton_order,
    opacities,
    smallest_three,
    to_bits,
    unit_quaternions,
    with_largest,
)

__all__ = ["read_sog", "sog_bytes", "sog_files", "write_sog"]

CODES = 256
# Rounds of Lloyd's algorithm for a codebook and for the palette.
CODE_ROUNDS, PALETTE_ROUNDS = 20, 3
# Largest palette, and the number of Gaussians per entry of a smaller one.
LARGEST_PALETTE, SHARE = 1 << 12, 16
ENTRIES_PER_ROW = 64
# Gaussians whose distances to the palette are computed at once.
BLOCK = 4096
# Largest meta.json that is read [bytes].
MOST_TEXT = 1 << 20
# Bytes of a Gaussian in the images. Most pixels of an image beyond twice those that are used, and of a palette.
SPLAT, SPARE, MOST_PALETTE = 20, 1 << 12, 1 << 20


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
        for name, data in sog_files({name: values[order] for name, values in state.items()}).items():
            archive.writestr(zipfile.ZipInfo(name), data)
    return content.getvalue()


def sog_files(state: Mapping[str, NDArray]) -> dict[str, bytes]:
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


def read_sog(data: bytes, path: Path) -> dict[str, NDArray]:
    """Read the content of a `.sog` file of version 2.

    Args:
        data: The content.
        path: The file, for error messages.

    Returns:
        Gaussians by name, as `GaussianField.load` takes them.

    Raises:
        InputError: If the file is damaged or of another version.
    """
    with reading(path, "; a .sog file of version 2 is wanted"), BoundedZip(data) as archive:
        if archive.getinfo("meta.json").file_size > MOST_TEXT:
            raise ValueError("a large meta.json")
        meta = parse_json(archive.read("meta.json").decode("utf-8"), f"{path}: meta.json")
        count = meta["count"]
        if meta["version"] != 2 or not isinstance(count, int) or count < 1:
            raise ValueError("another version")
        if count * SPLAT > most_unpacked(len(data)):
            raise ValueError(f"{count} splats in {len(data)} bytes")
        return _read(archive, meta, count)


def _read(archive: BoundedZip, meta: dict[str, Any], count: int) -> dict[str, NDArray]:
    means, harmonics = meta["means"], meta.get("shN")
    low, high = (np.array(means[bound], np.float64).reshape(3) for bound in ("mins", "maxs"))
    files = means["files"]
    steps = _pixels(archive, files[0], count)[:, :3] + 256.0 * _pixels(archive, files[1], count)[:, :3]
    place = low + steps / 65535.0 * (high - low)
    quats = _pixels(archive, meta["quats"]["files"][0], count)
    constant = _pixels(archive, meta["sh0"]["files"][0], count)
    sh = _codes(meta["sh0"])[constant[:, :3]][:, None]
    if harmonics is not None:
        coefficients = {1: 3, 2: 8, 3: 15}[harmonics["bands"]]
        entries = _codes(harmonics)[_pixels(archive, harmonics["files"][0])[:, :3]]
        labels = _pixels(archive, harmonics["files"][1], count).astype(np.int64)
        rest = entries.reshape(-1, coefficients, 3)[labels[:, 0] + 256 * labels[:, 1]]
        sh = np.concatenate([sh, rest], axis=1)
    largest = quats[:, 3].astype(np.int64) - 252
    if largest.min() < 0:
        raise ValueError("rotations of another form")
    return {
        "position": np.sign(place) * np.expm1(np.abs(place)),
        "log_scale": _codes(meta["scales"])[_pixels(archive, meta["scales"]["files"][0], count)[:, :3]],
        "quaternion": with_largest(largest, (quats[:, :3] / 255.0 * 2.0 - 1.0) * np.sqrt(0.5)),
        "opacity_logit": logits(constant[:, 3] / 255.0),
        "sh": sh,
    }


def _codes(part: dict[str, Any]) -> NDArray[np.float64]:
    """Return the codebook (256,) of a part. Raises ValueError unless it holds so many finite numbers."""
    codes = np.array(part["codebook"] if len(part["codebook"]) == CODES else np.nan)
    if codes.shape != (CODES,) or codes.dtype.kind not in "if" or not np.isfinite(codes).all():
        raise ValueError(f"a codebook of other than {CODES} finite numbers")
    return codes.astype(np.float64)


def _pixels(archive: BoundedZip, name: str, count: int | None = None) -> NDArray[np.uint8]:
    """Return the first `count` pixels (count, 4) of an image in the archive, row by row; all of a palette's if None."""
    from PIL import Image

    # Images hardly shrink further in an archive.
    entry = archive.getinfo(name)
    if entry.file_size > 2 * entry.compress_size + MOST_TEXT:
        raise ValueError("an image that unpacks to many times its size")
    data = archive.read(entry)
    if why_undecodable(data) is not None:
        raise ValueError("an image of a wrong size")
    with Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
        if not (count or 0) <= image.width * image.height <= (MOST_PALETTE if count is None else 2 * count + SPARE):
            raise ValueError(f"an image of {image.width}x{image.height} pixels, which is too small or too large")
        return np.asarray(image.convert("RGBA")).reshape(-1, 4)[:count]


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
