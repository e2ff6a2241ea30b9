"""Printed things of the demo room: books, a poster, a map, a clock face. All are (H, W, 3) uint8 sRGB."""

from __future__ import annotations

import cv2
import numpy as np

from modp_ti.inputs.synthetic.drawing import disc, polygon, text
from modp_ti.inputs.synthetic.noise import Image, blend, filled, finish, fractal, grid, mix, smooth_noise, smoothstep
from modp_ti.inputs.synthetic.pictures import landscape_painting

__all__ = [
    "book_cover",
    "book_spine",
    "chessboard",
    "clock_face",
    "contour_map",
    "editor_screen",
    "globe",
    "keyboard",
    "splat_poster",
]

WORDS = (
    "GAUSS RADON EULER BAYES NOETHER KALMAN LAPLACE FOURIER MERCATOR KEPLER HUYGENS SNELL LAMBERT FERMAT "
    "CAUCHY MOEBIUS ATLAS OPTICS LIGHT SHADOW FIELDS MAPS ROOMS VOXELS RAYS DEPTH COLOUR HORIZON PARALLAX "
    "GEOMETRY TEXTURE SURFACES"
).split()


def splat_poster(rng: np.random.Generator) -> Image:
    """An exhibition poster: a bowl of coloured Gaussians and fine print, 2 : 3."""
    height, width = 480, 320
    image = filled((height, width), (24, 30, 46))
    for _ in range(150):
        angle, radius = rng.uniform(0, 2 * np.pi), 118 * np.sqrt(rng.uniform())
        cx, cy = 160 + radius * np.cos(angle), 190 + 0.9 * radius * np.sin(angle)
        a, b, turn = rng.uniform(5, 22), rng.uniform(2.5, 7), angle + np.pi / 2 + rng.normal(0, 0.3)
        top, left = max(0, round(cy - 3 * a)), max(0, round(cx - 3 * a))
        part = image[top : round(cy + 3 * a), left : round(cx + 3 * a)]
        x, y = grid(part.shape[:2], part.shape[1::-1])
        x, y = x + (left - cx), y + (top - cy)
        u, v = (x * np.cos(turn) + y * np.sin(turn)) / a, (y * np.cos(turn) - x * np.sin(turn)) / b
        hue = (cx / width + 0.25 * rng.standard_normal()) * 3
        colour = 150 + 105 * np.sin(hue + np.array([0.3, 2.0, 4.1]))
        blend(part, colour, (0.9 * np.exp(-0.5 * (u * u + v * v))).astype(np.float32))
    text(image, "SPARSE FIELDS", (24, 352), 25, (240, 232, 214), 2)
    text(image, "an exhibition of rooms made of light", (26, 376), 9.5, (216, 196, 160))
    cv2.rectangle(image, (24, 388), (296, 389), (216, 120, 84), -1)
    for row in range(6):
        line = " ".join(rng.choice(WORDS, 5)).lower()[:44]
        text(image, line, (26, 406 + 11 * row), 6.5, (176, 184, 196))
    cv2.rectangle(image, (8, 8), (width - 9, height - 9), (216, 196, 160), 1)
    return finish(image)


def contour_map(rng: np.random.Generator) -> Image:
    """A hiking map with contour lines, a river, a grid and names, 4 : 3."""
    height, width = 330, 440
    level = fractal(rng, (height, width), 150, 5, 0.45)
    image = mix((206, 220, 176), (238, 226, 190), smoothstep(-1.0, 0.8, level))
    blend(image, (244, 240, 230), smoothstep(0.9, 2.0, level))
    forest = smoothstep(0.2, 0.5, fractal(rng, (height, width), 60, 4)) * smoothstep(0.9, 0.2, level)
    blend(image, (156, 190, 138), 0.8 * forest)
    slope = np.hypot(*np.gradient(level)) + 1e-3
    lines = np.abs(level * 9 - np.round(level * 9)) / (9 * slope)
    thick = np.abs(level * 1.8 - np.round(level * 1.8)) / (1.8 * slope)
    blend(image, (164, 116, 72), 0.7 * smoothstep(1.0, 0.3, lines))
    blend(image, (140, 92, 56), 0.9 * smoothstep(1.4, 0.6, thick))
    blend(image, (120, 172, 206), smoothstep(-1.45, -1.55, level))
    river = np.abs(smooth_noise(rng, (height, width), (160, 220)) + 0.15 * fractal(rng, (height, width), 60, 3))
    blend(image, (96, 150, 196), smoothstep(0.035, 0.02, river))
    for k in range(1, 8):
        image[:, k * 55 : k * 55 + 1] *= 0.82
    for k in range(1, 6):
        image[k * 55 : k * 55 + 1] *= 0.82
    for word in rng.choice(WORDS, 16, replace=False):
        at = rng.uniform(10, width - 90), rng.uniform(20, height - 12)
        disc(image, at, 2.2, (60, 40, 40))
        text(image, word.title(), (at[0] + 5, at[1] + 3), rng.choice([7, 8, 11]), (50, 40, 44))
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (250, 248, 240), 14)
    cv2.rectangle(image, (7, 7), (width - 8, height - 8), (90, 80, 70), 1)
    return finish(image)


def book_spine(rng: np.random.Generator) -> Image:
    """The back of a book, title from top to bottom, 1 : 6."""
    height, width = 40, 240  # drawn lying, turned at the end
    grounds = [
        (122, 38, 36),
        (38, 58, 92),
        (44, 84, 66),
        (188, 148, 84),
        (70, 54, 78),
        (206, 192, 162),
        (32, 34, 40),
        (168, 92, 56),
        (84, 112, 132),
        (196, 178, 70),
        (152, 160, 148),
        (90, 30, 52),
    ]
    ground = np.array(grounds[rng.integers(len(grounds))]) * rng.uniform(0.85, 1.15)
    dark = ground.mean() < 120
    ink = (232, 208, 150) if dark else (50, 40, 36)
    image = filled((height, width), ground)
    style = rng.integers(4)
    if style == 0:
        for at in (14, 20, 218, 224):
            image[:, at : at + 2] = ink
    elif style == 1:
        image[:, 150:196] = np.array(grounds[rng.integers(len(grounds))])
        image[:, 149:151] = ink
        image[:, 195:197] = ink
    elif style == 2:
        image[:, :36] = np.array(grounds[rng.integers(len(grounds))])
        disc(image, (18, 20), 8, ink)
    else:
        for at in (40, 90, 150, 200):
            image[:, at - 3 : at + 3] *= np.array([0.8, 1.15, 1.25, 1.25, 1.0, 0.75])[None, :, None]
    title = " ".join(rng.choice(WORDS, 2 if rng.random() < 0.5 else 1))
    tall = min(18.0, 160.0 / len(title))
    text(image, title, (44, 20 + tall / 2), tall, ink, 2 if tall > 12 else 1)
    text(image, rng.choice(WORDS).title(), (200 - 44 * (style == 1), 23), 6, ink)
    _, y = grid((height, width), (1.0, 1.0))
    image *= (0.72 + 0.28 * np.sin(np.pi * y) ** 0.5)[..., None]
    image *= (
        1 + 0.06 * fractal(rng, (height, width), 20, 4) + 0.04 * rng.standard_normal((height, width), np.float32)
    )[..., None]
    return np.ascontiguousarray(np.rot90(finish(image), -1))


def book_cover(rng: np.random.Generator) -> Image:
    """The front of a book or magazine, 3 : 4."""
    height, width = 256, 192
    image = filled((height, width), 60 + 170 * rng.random(3))
    u, v = grid((height, width), (192.0, 256.0))
    for _ in range(9):
        centre, radius = rng.uniform((0, 60), (width, height - 40)), rng.uniform(10, 60)
        ring = np.hypot(u - centre[0], v - centre[1])
        blend(image, 40 + 200 * rng.random(3), 0.7 * smoothstep(radius + 1, radius - 1, ring))
    image[:52] = (240, 236, 226)
    text(image, str(rng.choice(WORDS)), (12, 40), 24, (40, 36, 40), 3)
    for row in range(5):
        text(image, " ".join(rng.choice(WORDS, 3)).lower()[:28], (12, 190 + 13 * row), 7.5, (250, 250, 245))
    return finish(image)


def clock_face(rng: np.random.Generator) -> Image:
    """A white dial with numerals, at ten past ten."""
    size = 224
    image = filled((size, size), (246, 242, 232)) * (1 + 0.01 * fractal(rng, (size, size), 60, 3))[..., None]
    centre = np.array([size / 2, size / 2])
    disc(image, centre, 108, (60, 46, 38), 4)
    for minute in range(60):
        way = np.array([np.sin(minute * np.pi / 30), -np.cos(minute * np.pi / 30)])
        inner = 92 if minute % 5 else 88
        ends = [tuple(np.rint((centre + r * way) * 16).astype(int).tolist()) for r in (inner, 99)]
        cv2.line(image, *ends, (40, 36, 36), 1 if minute % 5 else 3, cv2.LINE_AA, 4)
        if minute % 5 == 0:
            hour = str(minute // 5 or 12)
            at = centre + 74 * way
            text(image, hour, (at[0] - 6.5 * len(hour), at[1] + 8), 16, (40, 36, 36), 2)
    for angle, length, thick in ((10 + 10 / 60, 48, 6), (2, 76, 4)):
        way = np.array([np.sin(angle * np.pi / 6), -np.cos(angle * np.pi / 6)])
        ends = [tuple(np.rint((centre + r * way) * 16).astype(int).tolist()) for r in (-12, length)]
        cv2.line(image, *ends, (30, 26, 28), thick, cv2.LINE_AA, 4)
    disc(image, centre, 6, (150, 60, 40))
    text(image, "MERIDIAN", (86, 150), 8, (90, 70, 60))
    return finish(image)


def chessboard(rng: np.random.Generator) -> Image:
    """Eight by eight fields with a wooden border."""
    size = 224
    x, y = grid((size, size), (9.0, 9.0))
    light = mix((214, 180, 132), (196, 156, 106), 0.5 + 0.3 * smooth_noise(rng, (size, size), (2, 40)))
    dark = mix((104, 62, 38), (84, 48, 30), 0.5 + 0.3 * smooth_noise(rng, (size, size), (2, 40)))
    black = ((np.floor(x - 0.5) + np.floor(y - 0.5)) % 2).astype(np.float32)
    image = mix(light, dark, black)
    border = (np.minimum(np.minimum(x, 9 - x), np.minimum(y, 9 - y)) < 0.5).astype(np.float32)
    return finish(mix(image, dark * 0.8, border))


def editor_screen(rng: np.random.Generator) -> Image:
    """A laptop's screen with a program and a small picture, 8 : 5."""
    height, width = 250, 400
    image = filled((height, width), (26, 30, 40))
    image[:14] = (46, 52, 66)
    for k, colour in enumerate(((232, 98, 88), (238, 190, 80), (104, 196, 96))):
        disc(image, (10 + 11 * k, 7), 3.2, colour)
    inks = [(214, 160, 110), (130, 180, 224), (156, 200, 130), (200, 204, 212), (196, 140, 200)]
    for row in range(21):
        text(image, str(row + 1), (6, 28 + 10.5 * row), 6, (90, 98, 116))
        at, end = 28 + 12 * int(rng.integers(0, 4)), rng.uniform(120, 255)
        while at < end:
            word = str(rng.choice(WORDS)).lower()
            text(image, word, (at, 28 + 10.5 * row), 6.2, inks[rng.integers(len(inks))])
            at += 5.6 * len(word) + 8
    inset = cv2.resize(landscape_painting(rng), (120, 80), interpolation=cv2.INTER_AREA)
    image[24:104, 270:390] = inset
    _u, _ = grid((90, 120), (1.0, 1.0))
    image[120:210, 270:390] = (36, 42, 56)
    curve = 70 * np.exp(-3 * np.linspace(0, 1, 110)) + 4 * rng.standard_normal(110) + 8
    points = np.stack([275 + np.arange(110), 205 - (78 - curve)], axis=1)
    cv2.polylines(image, [np.rint(points).astype(np.int32)], False, (104, 196, 160), 2, cv2.LINE_AA)
    return finish(image)


def keyboard(rng: np.random.Generator) -> Image:
    """Keys and touch pad of a laptop, 8 : 5."""
    height, width = 160, 256
    image = filled((height, width), (168, 170, 174))
    for row in range(6):
        for column in range(14):
            x, y = 14 + 16.4 * column, 10 + 15 * row
            polygon(image, np.array([[x, y], [x + 14, y], [x + 14, y + 12], [x, y + 12]]), (42, 44, 48))
            text(image, chr(int(rng.integers(65, 91))), (x + 4, y + 9), 6, (200, 202, 206))
    polygon(image, np.array([[88, 108], [168, 108], [168, 152], [88, 152]]), (152, 154, 158))
    return finish(image)


def globe(rng: np.random.Generator) -> Image:
    """Continents, ice and a graticule on a sphere's chart, 2 : 1."""
    height, width = 192, 384
    u, v = grid((height, width), (24.0, 12.0))
    land = fractal(rng, (height, width), 90, 6, 0.55)
    image = mix((52, 104, 150), (84, 140, 178), smoothstep(-1.6, 0.2, land))
    coast = smoothstep(0.30, 0.36, land)
    ground = mix((196, 178, 112), (110, 140, 80), smoothstep(0.3, 1.2, np.sin(np.pi * v / 12) * 1.6 + 0.4 * land - 0.5))
    image = mix(image, ground, coast)
    blend(image, (240, 240, 236), smoothstep(1.15, 0.75, np.minimum(v, 12 - v) + 0.3 * land))
    lines = np.minimum(np.abs(u - np.round(u)), np.abs(v - np.round(v)))
    blend(image, (70, 60, 50), 0.5 * smoothstep(0.05, 0.02, lines))
    return finish(image)
