"""The textures of the demo room by name."""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np

from modp_ti.inputs.synthetic import pictures, prints, textures
from modp_ti.inputs.synthetic.noise import Image

__all__ = ["COVERS", "SPINES", "make_textures"]

SPINES = tuple(f"spine{k}" for k in range(28))
COVERS = tuple(f"cover{k}" for k in range(4))

FLOOR = (4.8, 4.0)  # [m], one repetition
BRICK = (1.776, 1.232)
RUG = (2.1, 1.5)

MAKERS: dict[str, Callable[[np.random.Generator], Image]] = {
    "floor": lambda rng: textures.wood_floor(rng, *FLOOR, 0.003),
    "brick": lambda rng: textures.brick(rng, *BRICK, 0.0025),
    "rug": lambda rng: textures.rug(rng, *RUG, 0.002),
    "plaster": lambda rng: textures.plaster(rng, (233, 226, 211)),
    "white": lambda rng: textures.plaster(rng, (238, 236, 230), 256),
    "wallpaper": textures.wallpaper,
    "panelling": textures.panelling,
    "walnut": lambda rng: textures.wood(rng, (150, 98, 60), (82, 48, 28)),
    "oak": lambda rng: textures.wood(rng, (206, 164, 112), (156, 110, 68), rings=9),
    "black": lambda rng: textures.wood(rng, (52, 50, 50), (28, 26, 26)),
    "weave": textures.weave,
    "velvet": lambda rng: textures.weave(rng, (62, 112, 118), 96),
    "stripes": lambda rng: textures.stripes(
        rng, [(208, 92, 66), (232, 218, 192), (46, 66, 96), (232, 218, 192)], [3, 1, 1.5, 1]
    ),
    "triangles": lambda rng: textures.triangles(rng, [(228, 178, 84), (52, 92, 112), (230, 220, 204), (192, 92, 72)]),
    "mustard": lambda rng: textures.weave(rng, (214, 160, 58), 48),
    "curtain": lambda rng: textures.pleats(rng, (214, 190, 158), 6),
    "lampshade": lambda rng: textures.pleats(rng, (255, 226, 176), 48),
    "wicker": textures.wicker,
    "terracotta": textures.terracotta,
    "stoneware": lambda rng: textures.speckle(rng, (212, 218, 214), (56, 84, 122)),
    "indigo": lambda rng: textures.speckle(rng, (44, 66, 112), (226, 226, 220), 0.03),
    "brass": lambda rng: textures.speckle(rng, (196, 152, 80), (150, 108, 52), 0.05),
    "soil": lambda rng: textures.speckle(rng, (62, 44, 32), (104, 80, 60), 0.2),
    "coffee": lambda rng: textures.speckle(rng, (58, 34, 22), (150, 110, 74), 0.04),
    "orange": lambda rng: textures.peel(rng, (238, 142, 42)),
    "lemon": lambda rng: textures.peel(rng, (240, 210, 74)),
    "apple": lambda rng: textures.peel(rng, (178, 46, 40)),
    "leaf": textures.leaf,
    "pages": textures.pages,
    "landscape": pictures.landscape_painting,
    "abstract": pictures.abstract_painting,
    "poster": prints.splat_poster,
    "map": prints.contour_map,
    "fern": pictures.botanical_print,
    "photo": pictures.photograph,
    "view": pictures.window_view,
    "clock": prints.clock_face,
    "chess": prints.chessboard,
    "screen": prints.editor_screen,
    "keys": prints.keyboard,
    "globe": prints.globe,
    **dict.fromkeys(SPINES, prints.book_spine),
    **dict.fromkeys(COVERS, prints.book_cover),
}


def make_textures() -> dict[str, Image]:
    """Every texture, (H, W, 3) uint8 sRGB. Each has its own seed: a new one does not change the others."""
    return {name: make(np.random.default_rng(zlib.crc32(name.encode()))) for name, make in MAKERS.items()}
