"""The demo room: walls, light, and what stands where. x to the right, y to the back, z up; metres."""

from __future__ import annotations

import numpy as np

from modp_ti.inputs.synthetic import furniture as f
from modp_ti.inputs.synthetic.palette import BRICK, FLOOR, RUG, make_textures
from modp_ti.inputs.synthetic.scene import Light, Material, Scene, rotation

__all__ = ["EXPOSURE", "LIT_LOWER", "LIT_UPPER", "SUN", "build_room"]

LIT_LOWER, LIT_UPPER = (
    (-2.6, -2.0, 0.0),
    (2.4, 2.0, 2.6),
)  # where light is baked: the room and the window's reveal
WINDOW_LOWER, WINDOW_UPPER = (-0.35, 0.85), (1.15, 2.25)  # (y, z) in the wall x = -2.4

EXPOSURE = 2.0

_SUN_WAY = np.array([-1.0, -0.22, 0.72]) / np.linalg.norm([-1.0, -0.22, 0.72])
SUN = np.array(
    [_SUN_WAY, (4.4, 3.8, 2.9), (-2.4, *WINDOW_LOWER), (-2.4, *WINDOW_UPPER)], np.float32
)  # as `raytracer.sunlight` takes it


def build_room() -> Scene:
    """The whole scene with its lights."""
    s = Scene(make_textures())
    _shell(s)
    _window_wall(s)
    _back_wall(s)
    _brick_wall(s)
    _middle(s)
    _behind(s)
    _lights(s)
    return s


def _shell(s: Scene) -> None:
    plaster = Material("plaster", (1.6, 1.6))
    paper = Material("wallpaper", (0.64, 0.64))
    bricks = Material("brick", BRICK)
    s.box((0, 0, -0.1), (5.2, 4.4, 0.2), Material("floor", FLOOR))
    s.box((0, 0, 2.7), (5.2, 4.4, 0.2), plaster)
    s.box((0, 2.1, 1.3), (5.2, 0.2, 2.6), paper)
    s.box((0, -2.1, 1.3), (5.2, 0.2, 2.6), plaster)
    s.box((2.5, 0, 1.3), (0.2, 4.0, 2.6), bricks)
    (y0, z0), (y1, z1) = WINDOW_LOWER, WINDOW_UPPER
    for low, high, bottom, top in (
        (-2.0, 2.0, 0.0, z0),
        (-2.0, 2.0, z1, 2.6),
        (-2.0, y0, z0, z1),
        (y1, 2.0, z0, z1),
    ):
        s.box((-2.5, (low + high) / 2, (bottom + top) / 2), (0.2, high - low, top - bottom), plaster)
    # Wainscot, skirting and picture rail on the back wall; skirting elsewhere.
    s.box((0, 1.99, 0.44), (4.8, 0.02, 0.80), Material("panelling", (0.48, 0.80)))
    s.box((0, 1.98, 0.855), (4.8, 0.04, 0.03), f.WHITE)
    s.box((0, 1.985, 0.05), (4.8, 0.03, 0.10), f.WHITE)
    s.box((0, -1.985, 0.05), (4.8, 0.03, 0.10), f.WHITE)
    for x in (-2.385, 2.385):
        s.box((x, 0, 0.05), (0.03, 4.0, 0.10), f.WHITE)
    s.box((0, 1.98, 2.57), (4.8, 0.05, 0.06), f.WHITE)


def _window_wall(s: Scene) -> None:
    (y0, z0), (y1, z1) = WINDOW_LOWER, WINDOW_UPPER
    s.box((-6.4, 0.6, 1.55), (0.1, 9.0, 6.0), f.BLACK, x1=Material("view", emission=0.8))
    with s.placed((-2.4, (y0 + y1) / 2, z0), 90):
        f.window(s, y1 - y0, z1 - z0)
    s.rod((-2.30, y0 - 0.42, 2.42), (-2.30, y1 + 0.42, 2.42), 0.014, f.BRASS)
    for y in (y0 - 0.16, y1 + 0.16):
        with s.placed((-2.30, y, 0.02), 90):
            f.curtain(s, 0.44, 2.40, 7)
    rng = np.random.default_rng(11)
    with s.placed((-2.08, 0.42, 0), 90):
        f.desk(s)
        with s.placed((0.0, -0.02, 0.74), -8):
            f.laptop(s)
        with s.placed((-0.46, 0.12, 0.74), 30):
            f.desk_lamp(s)
        with s.placed((0.28, -0.12, 0.74), 60):
            f.mug(s, "indigo")
        with s.placed((0.44, 0.06, 0.74), 8):
            f.books_stack(s, rng, 4)
        s.box((-0.30, -0.15, 0.742), (0.21, 0.15, 0.004), f.WHITE, 14, z1=Material("map"))
    with s.placed((-1.52, 0.30, 0), -70):
        f.chair(s)
    with s.placed((-2.28, -1.25, 1.25), 90):
        f.framed(s, "fern", 0.42, 0.56, mat=0.05)
    with s.placed((-2.02, 1.62, 0)):
        f.plant(s, np.random.default_rng(5), 1.55, 6, 6)


def _back_wall(s: Scene) -> None:
    with s.placed((-0.15, 1.52, 0)):
        f.sofa(s)
    with s.placed((-1.40, 1.66, 0)):
        f.floor_lamp(s)
    for x, z, picture, width, height, mat in (
        (-0.20, 1.28, "landscape", 0.96, 0.66, 0.0),
        (-1.02, 1.34, "abstract", 0.46, 0.46, 0.05),
        (0.62, 1.26, "fern", 0.42, 0.56, 0.05),
    ):
        with s.placed((x, 1.97, z)):
            f.framed(s, picture, width, height, mat=mat)
    with s.placed((1.70, 1.82, 0)):
        f.bookshelf(s, np.random.default_rng(3))
    with s.placed((1.45, 1.78, 2.06)):
        f.vase(s, "stoneware", 0.28, 0.10)
    s.box((1.98, 1.80, 2.16), (0.36, 0.24, 0.20), Material("wicker", (0.18, 0.18)))


def _brick_wall(s: Scene) -> None:
    rng = np.random.default_rng(7)
    with s.placed((2.16, 0.10, 0), -90):
        f.sideboard(s)
        with s.placed((-0.45, 0.02, 0.72), 8):
            f.radio(s)
        with s.placed((0.02, 0.06, 0.72)):
            f.vase(s, "stoneware", 0.30, 0.085)
            for k in range(7):
                a = 2.4 * k
                top = np.array([0.13 * np.cos(a), 0.13 * np.sin(a), 0.44 + 0.03 * (k % 3)])
                s.rod((0, 0, 0.28), top, 0.004, Material("leaf"))
                s.ellipsoid(top, (0.034, 0.034, 0.026), Material("apple" if k % 2 else "lemon"))
        with s.placed((0.30, 0.08, 0.72), -10):
            f.framed(s, "photo", 0.22, 0.18, lean=14)
        with s.placed((0.55, -0.02, 0.72), 14):
            f.books_stack(s, rng, 3, 0.26)
            with s.placed((0, 0, 0.1)):
                f.mug(s, "stoneware")
    with s.placed((2.375, 0.62, 1.20), -90):
        f.framed(s, "poster", 0.52, 0.78)
    with s.placed((2.375, -0.28, 1.22), -90):
        f.framed(s, "map", 0.80, 0.60, mat=0.02)
    s.cylinder((2.37, 0.22, 2.18), 0.17, 0.05, f.BLACK, rotation(-90, 90), top=Material("clock"))
    with s.placed((1.98, -1.25, 0)):
        f.plant(s, np.random.default_rng(9), 1.1, 5, 6, "stoneware")


def _middle(s: Scene) -> None:
    s.box((0.05, 0.42, 0.006), (*RUG, 0.012), Material("weave", (0.2, 0.2)), -4, z1=Material("rug"))
    with s.placed((0.0, 0.55, 0.012), 3):
        f.coffee_table(s)
        s.box((-0.26, 0.02, 0.432), (0.30, 0.30, 0.024), f.WALNUT, 20, z1=Material("chess"))
        _chessmen(s)
        with s.placed((0.17, 0.06, 0.42)):
            f.fruit_bowl(s)
        with s.placed((0.38, -0.12, 0.42), 30):
            f.mug(s, "stoneware")
        s.box((0.06, -0.16, 0.424), (0.19, 0.25, 0.006), f.WHITE, -28, z1=Material("cover1"))
        with s.placed((-0.2, 0.0, 0.17), -6):
            f.books_stack(s, np.random.default_rng(2), 4, 0.28)
        s.box((0.2, 0.0, 0.23), (0.34, 0.26, 0.11), Material("wicker", (0.2, 0.2)))
    with s.placed((-0.95, 0.30, 0)):
        f.pouf(s)
    with s.placed((1.22, 0.72, 0), -52):
        f.armchair(s, Material("weave", (0.25, 0.25), tint=(0.62, 0.25, 0.17)))
    with s.placed((0.1, 0.5, 2.6)):
        f.pendant_lamp(s, 0.55)


def _chessmen(s: Scene) -> None:
    """A game in progress on the coffee table's board."""
    rng = np.random.default_rng(4)
    with s.placed((-0.26, 0.02, 0.444), 20):
        for k, square in enumerate(rng.choice(64, 18, replace=False)):
            x, y = ((square % 8) - 3.5) * 0.3 / 9, ((square // 8) - 3.5) * 0.3 / 9
            wood = f.OAK if k % 2 else f.BLACK
            tall = (0.035, 0.045, 0.06)[k % 3]
            s.cylinder((x, y, tall / 2), 0.011, tall, wood, top_radius=0.005)
            s.ellipsoid((x, y, tall + 0.004), 0.008, wood)


def _behind(s: Scene) -> None:
    """The wall that only a turning camera sees."""
    with s.placed((-0.6, -1.97, 1.1), 180):
        f.framed(s, "landscape", 1.2, 0.8)
    with s.placed((0.9, -1.97, 1.2), 180):
        f.framed(s, "map", 0.8, 0.6)
    s.box((0.2, -1.78, 0.25), (1.6, 0.4, 0.5), f.OAK)


def _lights(s: Scene) -> None:
    (y0, z0), (y1, z1) = WINDOW_LOWER, WINDOW_UPPER
    centre = (-2.4 - 0.10, (y0 + y1) / 2, (z0 + z1) / 2)
    s.lights.append(Light(centre, (0, (y1 - y0) / 2, 0), (0, 0, (z1 - z0) / 2), (1, 0, 0), (4.6, 5.2, 6.0)))
    s.lights.append(Light((0.1, 0.5, 2.05), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0), (34.0, 29.0, 22.0)))
    s.lights.append(Light((-1.40, 1.66, 1.47), (0.08, 0, 0), (0, 0.08, 0), (0, 0, 0), (22.0, 16.0, 10.0)))
