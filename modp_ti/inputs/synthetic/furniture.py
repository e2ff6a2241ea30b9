"""The pieces that stand in the demo room, each around the origin, on the floor z = 0, its front towards -y.

Place one with `with scene.placed(at, degrees):`. Lengths are metres.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from modp_ti.inputs.synthetic.palette import COVERS, SPINES
from modp_ti.inputs.synthetic.scene import Material, Scene, rotation

__all__ = [
    "armchair",
    "books_row",
    "books_stack",
    "bookshelf",
    "chair",
    "coffee_table",
    "curtain",
    "desk",
    "desk_lamp",
    "floor_lamp",
    "framed",
    "fruit_bowl",
    "laptop",
    "mug",
    "pendant_lamp",
    "plant",
    "pouf",
    "radio",
    "sideboard",
    "sofa",
    "vase",
    "window",
]

OAK = Material("oak", (0.6, 0.3))
WALNUT = Material("walnut", (0.6, 0.3))
UPRIGHT_OAK = Material("oak", (0.6, 0.3), turned=True)
UPRIGHT_WALNUT = Material("walnut", (0.6, 0.3), turned=True)
BLACK = Material("black", (0.4, 0.2))
BRASS = Material("brass", (0.15, 0.15))
WHITE = Material("white", (0.5, 0.5))
VELVET = Material("velvet", (0.22, 0.22))


def sofa(s: Scene) -> None:
    """A three-seater 2.0 m wide, 0.85 m deep, with four cushions."""
    for x in (-0.9, 0.9):
        for y in (-0.32, 0.32):
            s.cylinder((x, y, 0.06), 0.018, 0.12, WALNUT, top_radius=0.028)
    s.rounded((0, 0.0, 0.22), (1.96, 0.82, 0.20), 0.04, VELVET)
    for x in (-0.56, 0.0, 0.56):
        s.rounded((x, -0.06, 0.37), (0.555, 0.70, 0.17), 0.06, VELVET)
        s.rounded((x, 0.27, 0.62), (0.555, 0.20, 0.46), 0.08, VELVET, rotation(pitch=-10))
    for x in (-0.93, 0.93):
        s.rounded((x, -0.02, 0.40), (0.17, 0.82, 0.46), 0.07, VELVET)
    cushions = (
        (-0.68, 0.06, "stripes", 0.32, 24.0),
        (-0.36, 0.05, "mustard", 0.2, -8.0),
        (0.36, 0.06, "triangles", 0.34, 10.0),
        (0.68, 0.05, "stripes", 0.32, -22.0),
    )
    for x, y, texture, repeat, yaw in cushions:
        cloth = Material(texture, (repeat, repeat))
        s.rounded((x, y, 0.62), (0.40, 0.15, 0.38), 0.072, cloth, rotation(yaw, -20, 0.3 * yaw))


def armchair(s: Scene, cloth: Material) -> None:
    """A small armchair with wooden legs, 0.7 m wide."""
    for x in (-0.28, 0.28):
        for y in (-0.26, 0.26):
            s.rod((x * 1.1, y * 1.1, 0.0), (x, y, 0.22), 0.014, WALNUT, 0.022)
    s.rounded((0, -0.02, 0.33), (0.60, 0.60, 0.20), 0.07, cloth)
    s.rounded((0, 0.27, 0.62), (0.62, 0.16, 0.56), 0.075, cloth, rotation(pitch=-12))
    for x in (-0.33, 0.33):
        s.rounded((x, 0.0, 0.45), (0.11, 0.60, 0.26), 0.05, cloth)
    s.rounded((0, 0.13, 0.56), (0.38, 0.12, 0.32), 0.058, Material("triangles", (0.3, 0.3)), rotation(6, -20))


def pouf(s: Scene) -> None:
    """A round knitted stool."""
    cloth = Material("mustard", (0.22, 0.22))
    s.cylinder((0, 0, 0.19), 0.25, 0.28, cloth)
    s.ellipsoid((0, 0, 0.33), (0.25, 0.25, 0.07), cloth)
    s.ellipsoid((0, 0, 0.06), (0.25, 0.25, 0.06), cloth)


def chair(s: Scene) -> None:
    """A wooden chair with a seat pad."""
    for x in (-0.19, 0.19):
        s.rod((x * 1.1, -0.2, 0.0), (x, -0.17, 0.44), 0.014, OAK, 0.018)
        s.rod((x * 1.1, 0.22, 0.0), (x, 0.19, 0.86), 0.014, OAK, 0.016)
    s.rounded((0, 0, 0.455), (0.44, 0.43, 0.035), 0.015, OAK)
    s.rounded((0, -0.01, 0.485), (0.40, 0.38, 0.04), 0.018, Material("stripes", (0.2, 0.2)))
    for z in (0.60, 0.70, 0.80):
        s.rounded((0, 0.19 + 0.02 * (z - 0.7), z), (0.38, 0.018, 0.055), 0.008, OAK)


def coffee_table(s: Scene) -> None:
    """A low table 1.0 x 0.55 m with a lower shelf."""
    s.rounded((0, 0, 0.40), (1.0, 0.55, 0.04), 0.012, WALNUT)
    s.box((0, 0, 0.16), (0.86, 0.42, 0.02), WALNUT)
    for x in (-0.43, 0.43):
        for y in (-0.21, 0.21):
            s.rod((x * 1.05, y * 1.08, 0.0), (x, y, 0.38), 0.016, WALNUT, 0.024)


def desk(s: Scene, width: float = 1.2) -> None:
    """A desk 0.74 m high, 0.6 m deep, with a drawer block on the right."""
    s.box((0, 0, 0.725), (width, 0.60, 0.03), OAK)
    for y in (-0.26, 0.26):
        s.box((-width / 2 + 0.04, y, 0.355), (0.045, 0.045, 0.71), UPRIGHT_OAK)
    s.box((width / 2 - 0.21, 0, 0.40), (0.40, 0.54, 0.62), OAK)
    for k in range(3):
        z = 0.20 + 0.20 * k
        s.box((width / 2 - 0.21, -0.275, z), (0.36, 0.015, 0.175), OAK)
        s.rod((width / 2 - 0.25, -0.295, z), (width / 2 - 0.17, -0.295, z), 0.008, BRASS)


def sideboard(s: Scene, width: float = 1.5) -> None:
    """A low cabinet 0.72 m high, 0.42 m deep: two doors and three drawers."""
    for x in (-width / 2 + 0.08, width / 2 - 0.08):
        for y in (-0.15, 0.15):
            s.rod((x * 1.02, y, 0.0), (x, y, 0.16), 0.014, BLACK, 0.022)
    s.box((0, 0, 0.44), (width, 0.42, 0.56), WALNUT)
    door = width / 3
    for k in (-1, 1):
        s.box((k * door, -0.217, 0.44), (door - 0.03, 0.016, 0.50), UPRIGHT_WALNUT)
        s.ellipsoid((k * (door - door / 2 + 0.04), -0.235, 0.46), 0.014, BRASS)
    for k in range(3):
        s.box((0, -0.217, 0.275 + 0.168 * k), (door - 0.02, 0.016, 0.155), WALNUT)
        s.ellipsoid((0, -0.235, 0.275 + 0.168 * k), 0.012, BRASS)


def books_row(s: Scene, rng: np.random.Generator, width: float, height: float, depth: float) -> None:
    """Upright books side by side over `width` from x = 0, the last ones leaning where there is room."""
    x = 0.0
    while True:
        thick = rng.uniform(0.018, 0.050)
        if x + thick > width:
            break
        tall, deep = height * rng.uniform(0.72, 0.97), depth * rng.uniform(0.75, 0.95)
        spine = Material(SPINES[rng.integers(len(SPINES))])
        cover = Material("weave", (0.1, 0.1), tint=tuple(rng.uniform(0.08, 0.5, 3)))
        top = Material("pages", (0.05, 0.05), turned=True)
        s.box(
            (x + thick / 2, rng.uniform(0, 0.012) - 0.5 * (depth - deep), tall / 2),
            (thick - 0.001, deep, tall),
            cover,
            y0=spine,
            z1=top,
        )
        x += thick


def books_stack(s: Scene, rng: np.random.Generator, count: int, width: float = 0.24) -> None:
    """Books lying on each other, the topmost showing its cover, spines towards -y."""
    z = 0.0
    for _ in range(count):
        thick = rng.uniform(0.018, 0.04)
        size = width * rng.uniform(0.85, 1.0), 0.75 * width * rng.uniform(0.9, 1.0), thick
        spine = Material(SPINES[rng.integers(len(SPINES))], turned=True)
        cover = Material(COVERS[rng.integers(len(COVERS))])
        page = Material("pages", (0.05, 0.05))
        turn = rng.uniform(-12, 12)
        s.box((0, 0, z + thick / 2), size, page, turn, y0=spine, z1=cover)
        z += thick


def bookshelf(s: Scene, rng: np.random.Generator, width: float = 1.1, height: float = 2.05) -> None:
    """An open shelf, 0.30 m deep, five boards of books with a few things between them."""
    deep, board = 0.30, 0.025
    s.box((0, deep / 2 - 0.006, height / 2), (width, 0.012, height), UPRIGHT_OAK)
    for x in (-width / 2 + board / 2, width / 2 - board / 2):
        s.box((x, 0, height / 2), (board, deep, height), UPRIGHT_OAK)
    rows = 5
    pitch = (height - 0.1) / rows
    for k in range(rows + 1):
        s.box((0, 0, 0.07 + k * pitch), (width - 2 * board, deep - 0.01, board), OAK)
    inner = width - 2 * board - 0.02
    for k in range(rows):
        z = 0.07 + k * pitch + board / 2
        left = -inner / 2
        gap = (0.0, 0.30, 0.24, 0.34, 0.26)[k]
        first = (inner - gap) * (1.0, 0.65, 0.3, 0.55, 0.75)[k]
        with s.placed((left, -0.02, z)):
            books_row(s, rng, first, pitch - 0.05, 0.25)
        if gap:
            with s.placed((left + first + gap, -0.02, z)):
                books_row(s, rng, inner - first - gap, pitch - 0.05, 0.25)
            with s.placed((left + first + gap / 2, -0.04, z)):
                if k == 1:
                    books_stack(s, rng, 5, 0.22)
                elif k == 2:
                    vase(s, "indigo", 0.24, 0.07)
                elif k == 3:
                    s.cylinder((0, 0, 0.01), 0.06, 0.02, BLACK)
                    s.rod((0, 0, 0.02), (0, 0, 0.05), 0.008, BRASS)
                    s.ellipsoid((0, 0, 0.155), 0.11, Material("globe"), rotation(200, 23))
                else:
                    with s.placed((0, 0.05, 0), 12):
                        framed(s, "photo", 0.20, 0.16, lean=12)


def framed(s: Scene, picture: str, width: float, height: float, lean: float = 0.0, mat: float = 0.0) -> None:
    """A framed picture standing on z = 0, leaning back by degrees; `mat` is its white margin."""
    with s.placed((0, 0, 0), rotation(pitch=-lean)):
        bar = 0.022 if width < 0.4 else 0.032
        s.box((0, 0, height / 2), (width - bar, 0.012, height - bar), WHITE)
        s.box(
            (0, -0.0065, height / 2),
            (width - 2 * mat - bar, 0.004, height - 2 * mat - bar),
            BLACK,
            y0=Material(picture),
        )
        for x in (-width / 2, width / 2):
            s.box((x, -0.004, height / 2), (bar, 0.03, height + bar), UPRIGHT_WALNUT)
        for z in (0.0, height):
            s.box((0, -0.004, z), (width - bar, 0.03, bar), WALNUT)


def window(s: Scene, width: float, height: float) -> None:
    """Frame, glazing bars and sill of an opening centred on x = 0 from z = 0, seen from -y."""
    for x in (-width / 2 + 0.03, 0.0, width / 2 - 0.03):
        s.box((x, 0.05, height / 2), (0.06, 0.07, height), WHITE)
    for z in (0.03, height - 0.03):
        s.box((0, 0.05, z), (width, 0.07, 0.06), WHITE)
    s.box((0, 0.05, 0.66 * height), (width, 0.05, 0.035), WHITE)
    s.rounded((0, -0.06, -0.02), (width + 0.16, 0.26, 0.04), 0.012, WHITE)


def curtain(s: Scene, width: float, height: float, folds: int) -> None:
    """A gathered curtain hanging from z = height to the floor, centred on x = 0."""
    for k in range(folds):
        x = width * ((k + 0.5) / folds - 0.5)
        cloth = Material("curtain", (0.30, 0.6), offset=(0.37 * k, 0.21 * k))
        near = 0.012 * (-1) ** k
        s.cylinder((x, near, height / 2), 0.62 * width / folds, height, cloth, top_radius=0.50 * width / folds)


def floor_lamp(s: Scene) -> None:
    """A reading lamp 1.6 m high with a pleated shade."""
    s.cylinder((0, 0, 0.012), 0.15, 0.024, BLACK)
    s.rod((0, 0, 0.02), (0, 0, 1.40), 0.011, BRASS)
    s.cylinder((0, 0, 1.47), 0.20, 0.28, Material("lampshade", (0.6, 0.28), emission=0.8), top_radius=0.14)


def pendant_lamp(s: Scene, drop: float) -> None:
    """A wicker globe hanging `drop` below z = 0."""
    s.rod((0, 0, -drop + 0.15), (0, 0, 0), 0.006, BLACK)
    s.ellipsoid((0, 0, -drop), (0.21, 0.21, 0.18), Material("wicker", (0.25, 0.25), emission=0.6))


def desk_lamp(s: Scene) -> None:
    """An arm lamp with a cone."""
    s.cylinder((0, 0, 0.012), 0.075, 0.024, BLACK)
    s.rod((0, 0, 0.02), (-0.10, 0.02, 0.30), 0.008, BRASS)
    s.rod((-0.10, 0.02, 0.30), (0.10, 0.0, 0.46), 0.008, BRASS)
    s.cylinder((0.12, 0, 0.42), 0.075, 0.11, Material("mustard", (0.3, 0.3)), rotation(0, 0, -25), top_radius=0.028)


def laptop(s: Scene) -> None:
    """An open laptop 0.34 m wide, its screen towards -y."""
    metal = Material("white", (0.5, 0.5), tint=(0.55, 0.56, 0.6))
    s.rounded((0, 0, 0.009), (0.34, 0.235, 0.016), 0.005, metal)
    s.box((0, 0, 0.0175), (0.335, 0.23, 0.002), metal, z1=Material("keys"))
    with s.placed((0, 0.115, 0.016), rotation(pitch=-15)):
        s.box((0, 0.004, 0.11), (0.34, 0.008, 0.22), metal)
        s.box((0, -0.001, 0.112), (0.325, 0.003, 0.204), BLACK, y0=Material("screen", emission=0.6))


def mug(s: Scene, glaze: str) -> None:
    """A mug of coffee with a handle."""
    s.cylinder((0, 0, 0.045), 0.036, 0.09, Material(glaze, (0.11, 0.11)), top_radius=0.04, top=Material("coffee"))
    for a, b in (
        ((0.036, 0.072), (0.062, 0.066)),
        ((0.062, 0.066), (0.062, 0.034)),
        ((0.062, 0.034), (0.036, 0.024)),
    ):
        s.rod((a[0], 0, a[1]), (b[0], 0, b[1]), 0.007, Material(glaze, (0.11, 0.11)))


def vase(s: Scene, glaze: str, height: float, radius: float) -> None:
    """A bellied vase."""
    skin = Material(glaze, (0.2, 0.2))
    s.cylinder((0, 0, 0.03 * height), 0.6 * radius, 0.06 * height, skin)
    s.ellipsoid((0, 0, 0.42 * height), (radius, radius, 0.42 * height), skin)
    s.cylinder((0, 0, 0.88 * height), 0.36 * radius, 0.24 * height, skin, top_radius=0.5 * radius, top=BLACK)


def fruit_bowl(s: Scene) -> None:
    """A stoneware bowl with oranges, lemons and apples."""
    s.cylinder((0, 0, 0.035), 0.075, 0.07, Material("stoneware", (0.2, 0.2)), top_radius=0.15)
    fruit = (
        ("orange", 0.040),
        ("apple", 0.038),
        ("orange", 0.042),
        ("lemon", 0.034),
        ("apple", 0.039),
        ("lemon", 0.033),
    )
    for k, (name, radius) in enumerate(fruit):
        a = 2 * np.pi * k / len(fruit)
        size = (radius, radius, radius * (1.25 if name == "lemon" else 0.95))
        s.ellipsoid((0.082 * np.cos(a), 0.082 * np.sin(a), 0.088), size, Material(name), rotation(40 * k, 50 * k))
    s.ellipsoid((0.0, 0.005, 0.125), (0.041, 0.041, 0.039), Material("orange"))


def radio(s: Scene) -> None:
    """An old table radio: wooden case, cloth front, dial and knobs."""
    s.rounded((0, 0, 0.12), (0.40, 0.18, 0.23), 0.03, WALNUT)
    s.box((-0.06, -0.0905, 0.13), (0.22, 0.006, 0.16), Material("wicker", (0.06, 0.06)))
    s.cylinder(
        (0.12, -0.092, 0.155),
        0.05,
        0.008,
        Material("brass", (0.1, 0.1)),
        rotation(pitch=90),
        top=Material("clock"),
    )
    for x in (0.085, 0.155):
        s.cylinder((x, -0.1, 0.06), 0.018, 0.025, BLACK, rotation(pitch=90))


def plant(s: Scene, rng: np.random.Generator, height: float, stems: int, leaves: int, pot: str = "terracotta") -> None:
    """A pot plant with long leaves on arching stems."""
    rim = 0.17 * height / 1.5 + 0.05
    s.cylinder(
        (0, 0, 0.14),
        0.7 * rim,
        0.28,
        Material(pot, (0.4, 0.4)),
        top_radius=0.95 * rim,
        top=Material("soil", (0.2, 0.2)),
    )
    s.cylinder((0, 0, 0.285), rim, 0.045, Material(pot, (0.4, 0.4)), top=Material("soil", (0.2, 0.2)))
    green = Material("leaf", tint=(0.55, 0.62, 0.4))
    for k in range(stems):
        heading = 2 * np.pi * (k + rng.uniform(-0.25, 0.25)) / stems
        tall, lean = height * rng.uniform(0.55, 1.0), rng.uniform(0.10, 0.28) * height
        t = np.linspace(0, 1, 6)
        out = lean * t**1.7
        path = np.stack([out * np.cos(heading), out * np.sin(heading), 0.29 + (tall - 0.29) * t], axis=1)
        for a, b in pairwise(path):
            s.rod(a, b, 0.009, green)
        for n in range(leaves):
            at = 0.45 + 0.55 * (n + 1) / leaves
            base = np.array([np.interp(at, t, path[:, i]) for i in range(3)])
            way = heading + 2.4 * n + rng.uniform(-0.4, 0.4)
            long, droop = height * rng.uniform(0.11, 0.16), rng.uniform(-25, 35)
            turn = rotation(np.degrees(way) + 90, droop + 90) @ rotation(rng.uniform(-25, 25))
            # The leaf's length is its local z, its width x; it starts at the stem.
            tip = turn @ np.array([0.0, 0.0, long])
            tint = np.array([0.75, 0.85, 0.6]) * rng.uniform(0.7, 1.15)
            s.ellipsoid(base + tip, (0.40 * long, 0.035 * long, long), Material("leaf", tint=tuple(tint)), turn)
