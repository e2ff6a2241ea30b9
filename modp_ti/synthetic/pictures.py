"""Pictures of the demo room: paintings, posters, book spines, a clock face, the view from the window. (H, W, 3) uint8 sRGB."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from modp_ti.synthetic.noise import (
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
    "abstract_painting",
    "book_cover",
    "book_spine",
    "botanical_print",
    "chessboard",
    "clock_face",
    "contour_map",
    "editor_screen",
    "globe",
    "keyboard",
    "landscape_painting",
    "photograph",
    "splat_poster",
    "window_view",
]

WORDS = (
    "GAUSS RADON EULER BAYES NOETHER KALMAN LAPLACE FOURIER MERCATOR KEPLER HUYGENS SNELL LAMBERT FERMAT CAUCHY MOEBIUS "
    "ATLAS OPTICS LIGHT SHADOW FIELDS MAPS ROOMS VOXELS RAYS DEPTH COLOUR HORIZON PARALLAX GEOMETRY TEXTURE SURFACES"
).split()


def _text(
    image: Floats, words: str, at: tuple[float, float], height: float, colour: Colour, thickness: int = 1
) -> None:
    """Letters of `height` pixels, their baseline starting at `at` (x, y)."""
    top = max(0, round(at[1] - 1.6 * height))
    line = image[top : round(at[1] + 0.6 * height)]
    mask = np.zeros(line.shape[:2], np.uint8)  # OpenCV 5 writes on 8-bit images only
    place = (round(at[0]), round(at[1]) - top)
    cv2.putText(mask, str(words), place, cv2.FONT_HERSHEY_SIMPLEX, height / 21.0, 255, thickness, cv2.LINE_AA)
    blend(line, colour, mask.astype(np.float32) / 255)


def _disc(image: Floats, at: Sequence[float], radius: float, colour: Colour, outline: int = -1) -> None:
    centre = (round(at[0] * 16), round(at[1] * 16))
    cv2.circle(image, centre, round(radius * 16), tuple(colour), outline, cv2.LINE_AA, 4)


def _polygon(image: Floats, points: np.ndarray, colour: Colour) -> None:
    cv2.fillPoly(image, [np.rint(points * 16).astype(np.int32)], tuple(colour), cv2.LINE_AA, 4)


def _canvas(rng: np.random.Generator, image: Floats, strength: float = 0.05) -> Image:
    """The picture with brush strokes and the grain of canvas."""
    shape = image.shape[:2]
    tone = 1 + strength * (
        0.6 * smooth_noise(rng, shape, (2, 14)) + 0.6 * rng.standard_normal(shape, np.float32)
    )
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
    _disc(image, (1.02 * 320, 0.44 * 320), 15, (255, 246, 214))
    ridges = ((0.46, 0.075, (132, 120, 154)), (0.52, 0.060, (96, 92, 128)), (0.58, 0.040, (58, 70, 92)))
    for level, tall, colour in ridges:
        line = level - tall * _ridge(rng, width)
        rock = (
            filled((height, width), colour)
            * (1 + 0.13 * fractal(rng, (height, width), (22, 16), 5))[..., None]
        )
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
        smoothstep(0.9, 1.8, smooth_noise(rng, (height, width), (2, 18)))
        * np.exp(-(((x - 1.02) / 0.16) ** 2))
        * lake
    )
    blend(image, (255, 220, 160), glitter.astype(np.float32))
    shore = y > 0.9 - 0.03 * _ridge(rng, width)
    ground = (
        filled((height, width), (52, 62, 38))
        * (1 + 0.25 * fractal(rng, (height, width), (5, 12), 4))[..., None]
    )
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
            _polygon(
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
        _disc(overlay, centre, radius, ink)
        _disc(overlay, centre, 0.55 * radius, colours[(k + 2) % len(colours)])
        image += 0.75 * (overlay - image)
        _disc(image, centre, radius, (30, 30, 34), 1)
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
                    _polygon(image, p + q, colours[k] if k % 2 else (30, 30, 34))
    return _canvas(rng, image, 0.04)


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
    _text(image, "SPARSE FIELDS", (24, 352), 25, (240, 232, 214), 2)
    _text(image, "an exhibition of rooms made of light", (26, 376), 9.5, (216, 196, 160))
    cv2.rectangle(image, (24, 388), (296, 389), (216, 120, 84), -1)
    for row in range(6):
        line = " ".join(rng.choice(WORDS, 5)).lower()[:44]
        _text(image, line, (26, 406 + 11 * row), 6.5, (176, 184, 196))
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
    river = np.abs(
        smooth_noise(rng, (height, width), (160, 220)) + 0.15 * fractal(rng, (height, width), 60, 3)
    )
    blend(image, (96, 150, 196), smoothstep(0.035, 0.02, river))
    for k in range(1, 8):
        image[:, k * 55 : k * 55 + 1] *= 0.82
    for k in range(1, 6):
        image[k * 55 : k * 55 + 1] *= 0.82
    for word in rng.choice(WORDS, 16, replace=False):
        at = rng.uniform(10, width - 90), rng.uniform(20, height - 12)
        _disc(image, at, 2.2, (60, 40, 40))
        _text(image, word.title(), (at[0] + 5, at[1] + 3), rng.choice([7, 8, 11]), (50, 40, 44))
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (250, 248, 240), 14)
    cv2.rectangle(image, (7, 7), (width - 8, height - 8), (90, 80, 70), 1)
    return finish(image)


def botanical_print(rng: np.random.Generator) -> Image:
    """A drawn fern with a caption, 3 : 4."""
    height, width = 320, 240
    image = (
        filled((height, width), (240, 234, 218))
        * (1 + 0.02 * fractal(rng, (height, width), 60, 4))[..., None]
    )
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
                _disc(image, spot, 4.2 * (1 - 0.7 * t), green)
    _text(image, "Filix mas  L.", (76, 296), 12, (70, 60, 50))
    _text(image, "Tab. XVII", (168, 24), 8, (110, 96, 80))
    return finish(image)


def photograph(rng: np.random.Generator) -> Image:
    """A small sepia picture of a house among trees, 5 : 4."""
    height, width = 128, 160
    x, y = grid((height, width), (1.25, 1.0))
    image = mix((226, 214, 188), (190, 172, 140), y) + 8 * fractal(rng, (height, width), 30, 4)[..., None]
    _polygon(image, np.array([[50, 100], [50, 60], [80, 38], [112, 60], [112, 100]]), (120, 98, 74))
    _polygon(image, np.array([[44, 62], [80, 34], [118, 62], [112, 66], [80, 42], [50, 66]]), (70, 54, 42))
    for cx in (62, 92):
        _polygon(image, np.array([[cx, 70], [cx + 10, 70], [cx + 10, 84], [cx, 84]]), (226, 210, 170))
    for _ in range(60):
        _disc(
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
    x, y = grid(shape, (1.5, 1.0))
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
                _disc(image, spot, 0.30 * tall_tree * rng.uniform(0.6, 1.1), green * rng.uniform(0.85, 1.2))
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
        _disc(image, (18, 20), 8, ink)
    else:
        for at in (40, 90, 150, 200):
            image[:, at - 3 : at + 3] *= np.array([0.8, 1.15, 1.25, 1.25, 1.0, 0.75])[None, :, None]
    title = " ".join(rng.choice(WORDS, 2 if rng.random() < 0.5 else 1))
    tall = min(18.0, 160.0 / len(title))
    _text(image, title, (44, 20 + tall / 2), tall, ink, 2 if tall > 12 else 1)
    _text(image, rng.choice(WORDS).title(), (200 - 44 * (style == 1), 23), 6, ink)
    x, y = grid((height, width), (1.0, 1.0))
    image *= (0.72 + 0.28 * np.sin(np.pi * y) ** 0.5)[..., None]
    image *= (
        1
        + 0.06 * fractal(rng, (height, width), 20, 4)
        + 0.04 * rng.standard_normal((height, width), np.float32)
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
    _text(image, str(rng.choice(WORDS)), (12, 40), 24, (40, 36, 40), 3)
    for row in range(5):
        _text(image, " ".join(rng.choice(WORDS, 3)).lower()[:28], (12, 190 + 13 * row), 7.5, (250, 250, 245))
    return finish(image)


def clock_face(rng: np.random.Generator) -> Image:
    """A white dial with numerals, at ten past ten."""
    size = 224
    image = filled((size, size), (246, 242, 232)) * (1 + 0.01 * fractal(rng, (size, size), 60, 3))[..., None]
    centre = np.array([size / 2, size / 2])
    _disc(image, centre, 108, (60, 46, 38), 4)
    for minute in range(60):
        way = np.array([np.sin(minute * np.pi / 30), -np.cos(minute * np.pi / 30)])
        inner = 92 if minute % 5 else 88
        ends = [tuple(np.rint((centre + r * way) * 16).astype(int).tolist()) for r in (inner, 99)]
        cv2.line(image, *ends, (40, 36, 36), 1 if minute % 5 else 3, cv2.LINE_AA, 4)
        if minute % 5 == 0:
            hour = str(minute // 5 or 12)
            at = centre + 74 * way
            _text(image, hour, (at[0] - 6.5 * len(hour), at[1] + 8), 16, (40, 36, 36), 2)
    for angle, length, thick in ((10 + 10 / 60, 48, 6), (2, 76, 4)):
        way = np.array([np.sin(angle * np.pi / 6), -np.cos(angle * np.pi / 6)])
        ends = [tuple(np.rint((centre + r * way) * 16).astype(int).tolist()) for r in (-12, length)]
        cv2.line(image, *ends, (30, 26, 28), thick, cv2.LINE_AA, 4)
    _disc(image, centre, 6, (150, 60, 40))
    _text(image, "MERIDIAN", (86, 150), 8, (90, 70, 60))
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
        _disc(image, (10 + 11 * k, 7), 3.2, colour)
    inks = [(214, 160, 110), (130, 180, 224), (156, 200, 130), (200, 204, 212), (196, 140, 200)]
    for row in range(21):
        _text(image, str(row + 1), (6, 28 + 10.5 * row), 6, (90, 98, 116))
        at, end = 28 + 12 * int(rng.integers(0, 4)), rng.uniform(120, 255)
        while at < end:
            word = str(rng.choice(WORDS)).lower()
            _text(image, word, (at, 28 + 10.5 * row), 6.2, inks[rng.integers(len(inks))])
            at += 5.6 * len(word) + 8
    inset = cv2.resize(landscape_painting(rng), (120, 80), interpolation=cv2.INTER_AREA)
    image[24:104, 270:390] = inset
    u, _ = grid((90, 120), (1.0, 1.0))
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
            _polygon(image, np.array([[x, y], [x + 14, y], [x + 14, y + 12], [x, y + 12]]), (42, 44, 48))
            _text(image, chr(int(rng.integers(65, 91))), (x + 4, y + 9), 6, (200, 202, 206))
    _polygon(image, np.array([[88, 108], [168, 108], [168, 152], [88, 152]]), (152, 154, 158))
    return finish(image)


def globe(rng: np.random.Generator) -> Image:
    """Continents, ice and a graticule on a sphere's chart, 2 : 1."""
    height, width = 192, 384
    u, v = grid((height, width), (24.0, 12.0))
    land = fractal(rng, (height, width), 90, 6, 0.55)
    image = mix((52, 104, 150), (84, 140, 178), smoothstep(-1.6, 0.2, land))
    coast = smoothstep(0.30, 0.36, land)
    ground = mix(
        (196, 178, 112), (110, 140, 80), smoothstep(0.3, 1.2, np.sin(np.pi * v / 12) * 1.6 + 0.4 * land - 0.5)
    )
    image = mix(image, ground, coast)
    blend(image, (240, 240, 236), smoothstep(1.15, 0.75, np.minimum(v, 12 - v) + 0.3 * land))
    lines = np.minimum(np.abs(u - np.round(u)), np.abs(v - np.round(v)))
    blend(image, (70, 60, 50), 0.5 * smoothstep(0.05, 0.02, lines))
    return finish(image)
