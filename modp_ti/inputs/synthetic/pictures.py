"""Pictures of the demo room: paintings, prints, the view from the window. All are (H, W, 3) uint8 sRGB."""

from __future__ import annotations

import cv2
import numpy as np

from modp_ti.inputs.synthetic.drawing import disc, polygon, text
from modp_ti.inputs.synthetic.noise import (
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

__all__ = ["abstract_painting", "botanical_print", "landscape_painting", "photograph", "window_view"]


def _canvas(rng: np.random.Generator, image: Floats, strength: float = 0.05) -> Image:
    """The picture with brush strokes and the grain of canvas."""
    shape = image.shape[:2]
    tone = 1 + strength * (0.6 * smooth_noise(rng, shape, (2, 14)) + 0.6 * rng.standard_normal(shape, np.float32))
    return finish(image * tone[..., None])


def _ridge(rng: np.random.Generator, width: int, octaves: int = 6) -> Floats:
    """One row of a mountain line, zero mean, about unit height."""
    return fractal(rng, (1, width), (1, width / 2.5), octaves, 0.5)[0]


def landscape_painting(rng: np.random.Generator) -> Image:
    """Mountains over a lake at sunset, 3 : 2."""
    height, width = 320, 480
    x, y = grid((height, width), (1.5, 1.0))
    image = mix((64, 92, 142), (250, 190, 118), smoothstep(0.0, 0.55, y))
    cloud = smoothstep(0.1, 1.6, fractal(rng, (height, width), (26, 130), 5)) * smoothstep(0.62, 0.2, y)
    blend(image, (248, 170, 140), 0.75 * cloud)
    sun = np.hypot(x - 1.02, y - 0.44)
    blend(image, (255, 236, 190), np.exp(-((sun / 0.13) ** 2)))
    disc(image, (1.02 * 320, 0.44 * 320), 15, (255, 246, 214))
    ridges = ((0.46, 0.075, (132, 120, 154)), (0.52, 0.060, (96, 92, 128)), (0.58, 0.040, (58, 70, 92)))
    for level, tall, colour in ridges:
        line = level - tall * _ridge(rng, width)
        rock = filled((height, width), colour) * (1 + 0.13 * fractal(rng, (height, width), (22, 16), 5))[..., None]
        inside = smoothstep(-0.004, 0.004, y - line)
        image = mix(image, rock, inside)
        snow = (
            smoothstep(0.07, 0.0, y - line)
            * inside
            * (colour[0] > 90)
            * smoothstep(0.0, 0.5, fractal(rng, (height, width), (16, 9), 4))
        )
        blend(image, (236, 214, 216), 0.7 * snow)
    lake = y > 0.66
    mirror = image[::-1][
        np.clip((height - 1 - (2 * 0.66 * height - y * height)).astype(int), 0, height - 1),
        np.clip((x * 320 + 4 * np.sin(y * 260)).astype(int), 0, width - 1),
    ]
    image[lake] = (0.72 * mirror + 0.28 * np.array([70, 92, 120]))[lake]
    glitter = (
        smoothstep(0.9, 1.8, smooth_noise(rng, (height, width), (2, 18))) * np.exp(-(((x - 1.02) / 0.16) ** 2)) * lake
    )
    blend(image, (255, 220, 160), glitter.astype(np.float32))
    shore = y > 0.9 - 0.03 * _ridge(rng, width)
    ground = filled((height, width), (52, 62, 38)) * (1 + 0.25 * fractal(rng, (height, width), (5, 12), 4))[..., None]
    image = mix(image, ground, smoothstep(0.4, 0.6, shore.astype(np.float32)))
    for _ in range(16):
        cx, base = (
            rng.choice([rng.uniform(0, 0.42), rng.uniform(1.25, 1.5)]) * 320,
            rng.uniform(0.88, 0.97) * 320,
        )
        tall = rng.uniform(60, 130) * (base / 320) ** 2
        colour = np.array([30, 50, 42]) * rng.uniform(0.8, 1.4)
        for step in np.linspace(0, 1, 9):
            half = 0.20 * tall * (1 - step * 0.92)
            top = base - tall * step
            polygon(
                image,
                np.array([[cx - half, top], [cx + half, top], [cx, top - 0.22 * tall]]),
                colour * (0.85 + 0.3 * step),
            )
    return _canvas(rng, image, 0.07)


def abstract_painting(rng: np.random.Generator) -> Image:
    """Circles, bars and lines on a cream ground, square."""
    size = 320
    image = filled((size, size), (234, 222, 196)) * (1 + 0.03 * fractal(rng, (size, size), 90, 4))[..., None]
    colours = [(196, 62, 48), (232, 170, 56), (44, 74, 118), (58, 120, 108), (30, 30, 34), (222, 130, 110)]
    for k in range(15):
        centre, radius = rng.uniform(30, size - 30, 2), rng.uniform(12, 58) * (0.5 if k > 8 else 1)
        ink = colours[k % len(colours)]
        overlay = image.copy()
        disc(overlay, centre, radius, ink)
        disc(overlay, centre, 0.55 * radius, colours[(k + 2) % len(colours)])
        image += 0.75 * (overlay - image)
        disc(image, centre, radius, (30, 30, 34), 1)
    for k in range(12):
        a, angle, length = rng.uniform(20, size - 20, 2), rng.uniform(0, np.pi), rng.uniform(60, 210)
        b = a + length * np.array([np.cos(angle), np.sin(angle)])
        cv2.line(
            image,
            tuple(np.rint(a * 16).astype(int).tolist()),
            tuple(np.rint(b * 16).astype(int).tolist()),
            (30, 30, 34),
            1 + k % 3,
            cv2.LINE_AA,
            4,
        )
    for k in range(5):
        corner, side = rng.uniform(20, 250, 2), rng.uniform(30, 60)
        for row in range(5):
            for column in range(5):
                if (row + column) % 2:
                    p = corner + np.array([column, row]) * side / 5
                    q = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * side / 5
                    polygon(image, p + q, colours[k] if k % 2 else (30, 30, 34))
    return _canvas(rng, image, 0.04)


def botanical_print(rng: np.random.Generator) -> Image:
    """A drawn fern with a caption, 3 : 4."""
    height, width = 320, 240
    image = filled((height, width), (240, 234, 218)) * (1 + 0.02 * fractal(rng, (height, width), 60, 4))[..., None]
    s = np.linspace(0, 1, 40)
    stem = np.stack([120 + 26 * np.sin(2.4 * s), 268 - 226 * s], axis=1)
    cv2.polylines(image, [np.rint(stem * 16).astype(np.int32)], False, (70, 92, 52), 2, cv2.LINE_AA, 4)
    for k in range(3, 39, 2):
        for side in (-1, 1):
            long = 78 * np.sin(np.pi * (0.12 + 0.88 * s[k])) ** 0.8
            angle = -0.15 - 1.1 * s[k] * s[k]
            tip = stem[k] + long * np.array([side * np.cos(angle), np.sin(angle)])
            for t in np.linspace(0.08, 1, 12):
                spot = stem[k] + (tip - stem[k]) * t
                green = np.array([88, 124, 66]) * rng.uniform(0.75, 1.25)
                disc(image, spot, 4.2 * (1 - 0.7 * t), green)
    text(image, "Filix mas  L.", (76, 296), 12, (70, 60, 50))
    text(image, "Tab. XVII", (168, 24), 8, (110, 96, 80))
    return finish(image)


def photograph(rng: np.random.Generator) -> Image:
    """A small sepia picture of a house among trees, 5 : 4."""
    height, width = 128, 160
    _x, y = grid((height, width), (1.25, 1.0))
    image = mix((226, 214, 188), (190, 172, 140), y) + 8 * fractal(rng, (height, width), 30, 4)[..., None]
    polygon(image, np.array([[50, 100], [50, 60], [80, 38], [112, 60], [112, 100]]), (120, 98, 74))
    polygon(image, np.array([[44, 62], [80, 34], [118, 62], [112, 66], [80, 42], [50, 66]]), (70, 54, 42))
    for cx in (62, 92):
        polygon(image, np.array([[cx, 70], [cx + 10, 70], [cx + 10, 84], [cx, 84]]), (226, 210, 170))
    for _ in range(60):
        disc(
            image,
            (rng.choice([rng.normal(24, 10), rng.normal(136, 10)]), rng.normal(70, 16)),
            rng.uniform(3, 8),
            np.array([92, 80, 58]) * rng.uniform(0.7, 1.2),
        )
    blend(image, (110, 96, 66), smoothstep(0.76, 0.80, y))
    return finish(image * (1 + 0.05 * rng.standard_normal((height, width, 1))))


def window_view(rng: np.random.Generator) -> Image:
    """What lies outside: sky with clouds, hills, fields, trees; 3 : 2, the horizon at 58 % from the top."""
    height, width = 512, 768
    shape = (height, width)
    _x, y = grid(shape, (1.5, 1.0))
    image = mix((98, 152, 216), (214, 230, 240), smoothstep(0.0, 0.56, y))
    cloud = fractal(rng, shape, (70, 190), 6, 0.55) + 0.4 * smooth_noise(rng, shape, (120, 300))
    lit = smoothstep(0.25, 1.5, cloud) * smoothstep(0.60, 0.42, y)
    blend(image, (250, 250, 250), 0.95 * lit)
    blend(image, (176, 188, 206), 0.45 * smoothstep(1.3, 2.6, cloud) * smoothstep(0.6, 0.4, y))
    hills = (
        (0.53, 0.030, (138, 164, 182)),
        (0.57, 0.028, (112, 150, 142)),
        (0.62, 0.022, (104, 150, 92)),
        (0.68, 0.02, (124, 164, 80)),
    )
    for level, tall, colour in hills:
        line = level - tall * _ridge(rng, width, 3)
        field = filled(shape, colour) * (1 + 0.08 * fractal(rng, shape, (10, 60), 5))[..., None]
        image = mix(image, field, smoothstep(-0.003, 0.003, y - line))
        for _ in range(70):
            cx = rng.uniform(0, width)
            base = line[int(cx)] * height + rng.uniform(0, 0.03) * height
            tall_tree = 3 + 34 * max(level - 0.53, 0.01) / 0.15 * rng.uniform(0.6, 1.2)
            green = np.array(colour) * np.array([0.55, 0.66, 0.55]) * rng.uniform(0.8, 1.15)
            for _ in range(7):
                spot = (cx + rng.normal(0, 0.28 * tall_tree), base - tall_tree * rng.uniform(0.2, 0.9))
                disc(image, spot, 0.30 * tall_tree * rng.uniform(0.6, 1.1), green * rng.uniform(0.85, 1.2))
    return finish(image)
