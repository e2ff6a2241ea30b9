"""Procedural surfaces of the demo room: wood, brick, plaster, cloth, leaf and so on, as (H, W, 3) uint8 sRGB.

The functions take a random generator. Sizes are in metres where a surface has one: detail is life-size.
"""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.synthetic.drawing import polygon
from modp_ti.inputs.synthetic.noise import (
    Colour,
    Floats,
    Image,
    blend,
    filled,
    finish,
    fractal,
    grid,
    mix,
    smooth_noise,
    smoothstep,
)

__all__ = [
    "brick",
    "leaf",
    "pages",
    "panelling",
    "peel",
    "plaster",
    "pleats",
    "rug",
    "speckle",
    "stripes",
    "terracotta",
    "triangles",
    "wallpaper",
    "weave",
    "wicker",
    "wood",
    "wood_floor",
]


def _grain(rng: np.random.Generator, shape: tuple[int, int], rings: float) -> Floats:
    """Wood grain along x in about [-1, 1]: warped year rings and fine pores."""
    _x, y = grid(shape, (shape[1], shape[0]))
    warp = fractal(rng, shape, (shape[0] / 3, shape[1] / 2), 3)
    ring = np.sin((y / shape[0] + 0.09 * warp) * rings * 2 * np.pi)
    pores = smooth_noise(rng, shape, (1.0, 28.0))
    return 0.55 * ring + 0.35 * pores + 0.25 * smooth_noise(rng, shape, (3.0, 90.0))


def wood(rng: np.random.Generator, light: Colour, dark: Colour, size: int = 384, rings: float = 14) -> Image:
    """A board with the grain along x."""
    tone = _grain(rng, (size // 2, size), rings)
    return finish(mix(light, dark, np.clip(0.42 + 0.3 * tone, 0, 1)))


def wood_floor(rng: np.random.Generator, width: float, height: float, texel: float) -> Image:
    """Oak planks along x, 13 cm wide, each with its own tone, grain and ends."""
    shape = round(height / texel), round(width / texel)
    image = np.empty((*shape, 3), np.float32)
    rows = round(height / 0.13)
    edges = np.linspace(0, shape[0], rows + 1).round().astype(int)
    light, dark = np.array([196, 152, 104]), np.array([120, 80, 48])
    for top, bottom in pairwise(edges):
        start = -rng.integers(0, round(0.9 / texel))
        while start < shape[1]:
            end = start + round(rng.uniform(0.9, 1.7) / texel)
            a, b = max(start, 0), min(end, shape[1])
            tone = _grain(rng, (bottom - top, end - start), rng.uniform(2, 6))[:, a - start : b - start]
            tint = 1 + 0.13 * rng.standard_normal() + 0.02 * rng.standard_normal(3)
            plank = mix(light * tint, dark * tint, np.clip(0.30 + 0.26 * tone, 0, 1))
            if rng.random() < 0.35:
                x, y = grid(plank.shape[:2], plank.shape[1::-1])
                cx, cy = rng.uniform(0, plank.shape[1]), rng.uniform(0.3, 0.7) * plank.shape[0]
                knot = np.hypot((x - cx) * texel / 0.022, (y - cy) * texel / 0.013)
                blend(plank, dark * 0.55, 0.8 * np.exp(-(knot**2)))
            plank[0] *= 0.45
            plank[-1] *= 0.8
            if 0 <= start:
                plank[:, 0] *= 0.45
            image[top:bottom, a:b] = plank
            start = end
    image *= 1 + 0.05 * fractal(rng, shape, 0.5 / texel, 4)[..., None]
    return finish(image)


def brick(rng: np.random.Generator, width: float, height: float, texel: float) -> Image:
    """Running bond of 21 x 6.5 cm bricks with 1.2 cm joints; repeats."""
    shape = round(height / texel), round(width / texel)
    columns, rows = round(width / 0.222), 2 * round(height / 0.154)
    x, y = grid(shape, (columns, rows))
    # Joints are not drawn with a ruler.
    x = x + 0.02 * fractal(rng, shape, 0.05 / texel, 3)
    y = y + 0.035 * fractal(rng, shape, 0.05 / texel, 3)
    row = np.floor(y).astype(int) % rows
    along = x + 0.5 * (row % 2)
    column = np.floor(along).astype(int) % columns
    fx, fy = along - np.floor(along), y - np.floor(y)
    joint = np.minimum(np.minimum(fx, 1 - fx) * 0.222, np.minimum(fy, 1 - fy) * 0.077)
    inside = smoothstep(0.0035, 0.0075, joint.astype(np.float32))

    tones = np.array([[168, 92, 70], [150, 78, 60], [182, 108, 82], [138, 82, 68], [190, 124, 98], [120, 66, 56]])
    palette = tones[rng.integers(0, len(tones), (rows, columns))] * (1 + 0.07 * rng.standard_normal((rows, columns, 1)))
    face = palette[row, column].astype(np.float32)
    face *= (1 + 0.10 * fractal(rng, shape, 0.03 / texel, 4) + 0.05 * rng.standard_normal(shape, np.float32))[..., None]
    lime = smoothstep(0.9, 2.2, fractal(rng, shape, 0.25 / texel, 5))
    blend(face, (205, 192, 178), 0.5 * lime)
    face *= (0.86 + 0.14 * smoothstep(0.006, 0.016, joint.astype(np.float32)))[..., None]
    mortar = filled(shape, (176, 166, 152)) * (1 + 0.07 * fractal(rng, shape, 0.01 / texel, 3))[..., None]
    return finish(mix(mortar, face, inside))


def plaster(rng: np.random.Generator, colour: Colour, size: int = 640) -> Image:
    """Brushed plaster: clouds, strokes and grains of low contrast; repeats."""
    shape = (size, size)
    tone = 0.022 * fractal(rng, shape, size / 5, 5, 0.6)
    tone += 0.016 * smooth_noise(rng, shape, (2, 26)) + 0.016 * smooth_noise(rng, shape, (26, 2))
    tone += 0.012 * rng.standard_normal(shape, np.float32)
    return finish(filled(shape, colour) * (1 + tone)[..., None])


def wallpaper(rng: np.random.Generator, size: int = 512) -> Image:
    """Twigs with leaves and berries on a deep green ground; repeats over about 0.64 m."""
    shape = (size, size)
    image = filled(shape, (58, 84, 80)) * (1 + 0.03 * fractal(rng, shape, 60, 4))[..., None]
    inks = [(92, 124, 104), (122, 146, 112), (78, 112, 106), (156, 160, 120)]

    shifts = [np.array([dx, dy]) for dx in (-size, 0, size) for dy in (-size, 0, size)]

    def fill(outline: NDArray[np.float64], colour: Colour) -> None:
        for shift in shifts:  # all nine, so that twigs cross the border
            polygon(image, outline + shift, colour)

    def line(path: NDArray[np.float64], colour: Colour) -> None:
        for shift in shifts:
            points = np.rint((path + shift) * 16).astype(np.int32)
            cv2.polylines(image, [points], False, tuple(colour), 2, cv2.LINE_AA, 4)

    s = np.linspace(0, 1, 14)
    for k in range(26):
        gx, gy = (k * 0.618) % 1.0, (k + 0.5) / 26
        base = np.array([gx, gy]) * size + rng.uniform(-8, 8, 2)
        heading, bend, length = rng.uniform(0, 2 * np.pi), rng.uniform(-0.9, 0.9), rng.uniform(95, 150)
        angles = heading + bend * s
        path = base + np.cumsum(np.stack([np.cos(angles), np.sin(angles)], axis=1), axis=0) * length / len(s)
        ink = inks[k % len(inks)]
        line(path, tuple(0.8 * c for c in ink))
        for n in range(2, 14, 3):
            for side in (-1, 1):
                a = angles[n] + side * 0.85
                long, wide = 30 * (1 - 0.45 * s[n]), 7.0
                forward, across = np.array([np.cos(a), np.sin(a)]), np.array([-np.sin(a), np.cos(a)])
                bulge = np.sin(np.pi * s)[:, None] * across * wide
                spine = path[n] + np.outer(s, forward * long)
                outline = np.concatenate([spine + bulge, (spine - bulge)[::-1]])
                fill(outline, ink)
                line(path[n] + np.outer([0, 0.9], forward * long), tuple(0.72 * c for c in ink))
        for _ in range(3):
            spot = path[-1] + rng.uniform(-14, 14, 2)
            ring = spot + 3.6 * np.stack([np.cos(2 * np.pi * s), np.sin(2 * np.pi * s)], axis=1)
            fill(ring, (196, 120, 88))
    return finish(image)


def panelling(rng: np.random.Generator) -> Image:
    """One white-painted wainscot panel, 0.48 m wide and 0.8 m high: a bead frame around a flat field."""
    shape = (400, 240)
    x, y = grid(shape, (0.48, 0.80))
    edge = np.minimum(np.minimum(x, 0.48 - x) - 0.05, np.minimum(y, 0.80 - y) - 0.07)
    image = filled(shape, (226, 221, 208)) * (1 + 0.012 * _grain(rng, shape, 20))[..., None]
    shadow = np.exp(-(((edge - 0.004) / 0.004) ** 2)) * np.where((x < 0.24) ^ (y > 0.4), 1.0, 0.55)
    image *= (1 - 0.32 * shadow - 0.16 * np.exp(-(((edge - 0.016) / 0.003) ** 2)))[..., None]
    image += 16 * np.exp(-(((edge - 0.010) / 0.003) ** 2))[..., None]
    seam = np.exp(-((np.minimum(x, 0.48 - x) / 0.002) ** 2))
    return finish(image * (1 - 0.3 * seam)[..., None])


def weave(rng: np.random.Generator, colour: Colour = (225, 225, 225), threads: int = 64, size: int = 384) -> Image:
    """Plain weave with slubs; repeats."""
    x, y = grid((size, size), (threads, threads))
    over = (np.floor(x) + np.floor(y)) % 2
    bulge = np.where(over > 0, np.abs(np.sin(np.pi * y)), np.abs(np.sin(np.pi * x)))
    slub = np.where(over > 0, smooth_noise(rng, (size, size), (3, 50)), smooth_noise(rng, (size, size), (50, 3)))
    tone = 0.80 + 0.22 * bulge + 0.09 * slub + 0.05 * fractal(rng, (size, size), 60, 3)
    return finish(filled((size, size), colour) * tone[..., None])


def stripes(rng: np.random.Generator, colours: list[Colour], widths: list[float], size: int = 320) -> Image:
    """Woven stripes across x; the widths are shares of one repeat."""
    x, _ = grid((size, size), (sum(widths), 1.0))
    image = np.empty((size, size, 3), np.float32)
    for colour, low, width in zip(colours, np.cumsum([0, *widths[:-1]]), widths, strict=True):
        image[(x >= low) & (x < low + width)] = colour
    return finish(image * (weave(rng, (255, 255, 255), 80, size) / np.float32(235)))


def triangles(rng: np.random.Generator, colours: list[Colour], count: int = 6, size: int = 320) -> Image:
    """A patchwork of woven triangles; repeats."""
    x, y = grid((size, size), (count, count))
    upper = (x - np.floor(x)) > (y - np.floor(y))
    pick = rng.integers(0, len(colours), (2, count, count))
    index = np.where(
        upper,
        pick[0][np.floor(y).astype(int), np.floor(x).astype(int)],
        pick[1][np.floor(y).astype(int), np.floor(x).astype(int)],
    )
    image = np.asarray(colours, np.float32)[index]
    return finish(image * (weave(rng, (255, 255, 255), 80, size) / np.float32(235)))


def rug(rng: np.random.Generator, width: float, height: float, texel: float) -> Image:
    """A knotted rug: fringes, three borders with motifs, a field of lozenges around a medallion."""
    shape = round(height / texel), round(width / texel)
    x, y = grid(shape, (width, height))
    x, y = np.abs(x - width / 2), np.abs(y - height / 2)
    edge = np.minimum(width / 2 - 0.05 - x, height / 2 - y)
    navy, red, cream, gold, teal = (
        (38, 48, 84),
        (148, 46, 44),
        (222, 204, 170),
        (198, 148, 78),
        (64, 112, 116),
    )
    image = filled(shape, red)

    u, v = x / 0.11, y / 0.11
    lozenge = np.abs(u - np.round(u)) + np.abs(v - np.round(v))
    alternate = (np.round(u) + np.round(v)) % 2
    image[(lozenge < 0.34) & (alternate > 0)] = navy
    image[(lozenge < 0.22) & (alternate > 0)] = gold
    image[(lozenge < 0.10)] = cream
    image[(lozenge < 0.16) & (alternate < 1)] = teal
    image[(lozenge < 0.07) & (alternate < 1)] = cream

    star = np.hypot(x, y * 1.25) * (1 + 0.10 * np.cos(8 * np.arctan2(y * 1.25, x)))
    for radius, colour in (
        (0.43, cream),
        (0.41, navy),
        (0.33, gold),
        (0.31, red),
        (0.22, cream),
        (0.20, teal),
        (0.12, gold),
        (0.09, navy),
        (0.04, cream),
    ):
        image[star < radius] = colour
    petals = np.cos(16 * np.arctan2(y * 1.25, x))
    image[(star > 0.335) & (star < 0.405) & (petals > 0.55)] = gold
    image[(star > 0.225) & (star < 0.305) & (petals < -0.5)] = cream

    along = np.where(width / 2 - 0.05 - x < height / 2 - y, y, x)
    for low, high, ground, motif, pitch in (
        (0.0, 0.05, navy, gold, 0.05),
        (0.05, 0.15, cream, red, 0.10),
        (0.15, 0.19, teal, cream, 0.04),
    ):
        band = (edge >= low) & (edge < high)
        image[band] = ground
        across = (edge - low) / (high - low) - 0.5
        phase = along / pitch - np.round(along / pitch)
        image[band & (np.abs(phase) + np.abs(across) < 0.36)] = motif
        image[band & (np.abs(phase) + np.abs(across) < 0.16)] = navy if ground != navy else red
        image[band & (np.abs(across) > 0.44)] = navy
    pile = (
        1
        + 0.10 * rng.standard_normal(shape, np.float32)
        + 0.05 * smooth_noise(rng, shape, (2, 40))
        + 0.05 * fractal(rng, shape, 80, 3)
    )
    image *= pile[..., None]
    fringe = edge < 0
    threads = 0.75 + 0.35 * (np.sin(y / 0.006 * np.pi) > 0)
    image[fringe] = (np.array([214, 200, 172]) * threads[..., None])[fringe]
    return finish(image)


def wicker(rng: np.random.Generator, size: int = 256) -> Image:
    """Basket weave of flat strands; repeats."""
    x, y = grid((size, size), (8, 16))
    over = (np.floor(x) + np.floor(y)) % 2
    fx, fy = x - np.floor(x), y - np.floor(y)
    tone = np.where(
        over > 0,
        np.sin(np.pi * fy) ** 0.5 * (0.7 + 0.3 * np.sin(np.pi * fx)),
        0.45 * np.sin(np.pi * fx) ** 0.5 + 0.25,
    )
    tone = tone + 0.06 * smooth_noise(rng, (size, size), (2, 20))
    return finish(mix((70, 44, 22), (206, 164, 108), np.clip(tone, 0, 1).astype(np.float32)))


def speckle(rng: np.random.Generator, ground: Colour, spots: Colour, share: float = 0.06, size: int = 256) -> Image:
    """Stoneware glaze: a ground with small spots; repeats."""
    image = filled((size, size), ground) * (1 + 0.03 * fractal(rng, (size, size), 50, 4))[..., None]
    limit = float(np.quantile(field := fractal(rng, (size, size), 7, 2), 1 - share))
    blend(image, spots, smoothstep(limit, limit + 0.5, field))
    return finish(image)


def terracotta(rng: np.random.Generator, size: int = 256) -> Image:
    """Turned clay: rings, stains and lime; repeats."""
    shape = (size, size)
    tone = 1 + 0.05 * smooth_noise(rng, shape, (3, 200)) + 0.07 * fractal(rng, shape, 60, 5)
    image = filled(shape, (184, 104, 72)) * tone[..., None]
    blend(image, (216, 190, 168), 0.45 * smoothstep(0.6, 2.0, fractal(rng, shape, (40, 70), 5)))
    return finish(image)


def peel(rng: np.random.Generator, colour: Colour, size: int = 192) -> Image:
    """The skin of a fruit."""
    shape = (size, size)
    tone = 1 + 0.06 * fractal(rng, shape, 60, 3) - 0.10 * smoothstep(0.6, 1.6, smooth_noise(rng, shape, (4, 4)))
    return finish(filled(shape, colour) * tone[..., None])


def leaf(rng: np.random.Generator, size: int = 192) -> Image:
    """A leaf seen as an ellipsoid's chart: midrib at the middle of each side, veins off it."""
    shape = (size, size)
    u, v = grid(shape, (1.0, 1.0))
    across = np.abs((u * 2) % 1.0 - 0.5)
    image = filled(shape, (70, 122, 62)) * (1 + 0.10 * fractal(rng, shape, 40, 4))[..., None]
    vein = (v * 11 - across * 5) % 1.0
    blend(image, (128, 168, 100), 0.6 * smoothstep(0.12, 0.02, np.abs(vein - 0.5)))
    blend(image, (160, 190, 120), smoothstep(0.030, 0.012, across))
    return finish(image)


def pleats(rng: np.random.Generator, colour: Colour, count: int = 36, size: int = 256) -> Image:
    """Folded cloth or paper, folds along y; repeats across."""
    x, _y = grid((size, size), (count, 1.0))
    tone = 0.86 + 0.14 * np.sin(2 * np.pi * x) + 0.03 * smooth_noise(rng, (size, size), (2, 30))
    return finish(filled((size, size), colour) * tone[..., None])


def pages(rng: np.random.Generator) -> Image:
    """The cut edge of a book; repeats."""
    shape = (64, 128)
    tone = 1 + 0.09 * smooth_noise(rng, shape, (1.2, 60))
    return finish(filled(shape, (226, 214, 190)) * tone[..., None])
