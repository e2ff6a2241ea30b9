"""Scene description: primitives with materials, and the flat arrays that the kernels read.

A primitive is an affine image of a unit shape, so that one table row holds it whatever its kind:

    BOX      |x|, |y|, |z| <= 1
    SPHERE   |p| <= 1
    FRUSTUM  -1 <= z <= 1 with radius a + b z: (a, b) in the shape row; a cylinder where b = 0
    ROUNDED  a box of half sizes h with edges of radius r: (h, r) in the shape row, the map rigid

Its surface is cut into patches with coordinates (u, v) in [0, 1]^2, u to the right and v down as seen from
outside: six faces (+x -x +y -y +z -z) of a box, one of a sphere, and side, top, bottom of a frustum. A patch
carries a material and a rectangle of the light map. Lengths are metres, z points up.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["BOX", "FRUSTUM", "ROUNDED", "SPHERE", "Light", "Material", "Scene", "SceneArrays", "rotation"]

BOX, SPHERE, FRUSTUM, ROUNDED = 0, 1, 2, 3

MAX_MIP_LEVELS = 12
LEAF_SIZE = 2

Vector = Sequence[float]


@dataclass(frozen=True)
class Material:
    """How a patch looks.

    texture: name in the scene's textures. repeat: (width, height) of one repetition in metres, or None
    to stretch the texture over the patch once. offset: shift in repetitions. turned: it lies on its side.
    tint: factor on the linear colour. emission: 0 for a lit surface; otherwise the patch shows its colour
    times this.
    """

    texture: str
    repeat: tuple[float, float] | None = None
    offset: tuple[float, float] = (0.0, 0.0)
    turned: bool = False
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    emission: float = 0.0


@dataclass(frozen=True)
class Light:
    """An area light: points centre + s * edge_u + t * edge_v, s and t in [-1, 1].

    normal: the side that shines, or zero for a light that shines everywhere alike. radiance: RGB.
    """

    centre: Vector
    edge_u: Vector
    edge_v: Vector
    normal: Vector
    radiance: Vector


@dataclass(frozen=True)
class SceneArrays:
    """What the kernels read. P primitives, M nodes, K patches, N light-map texels, T textures, L lights.

    Whole numbers stand among the floats of a row; all are below 2^24, hence exact.

    primitives: (P, 8, 4), three rows world to local, three rows local to world, the shape, and (kind, first
    patch, 1 where it shines, unused).
    nodes: (M, 3, 4), (lower corner, first primitive), (upper corner, number of primitives), (node to go to
    when this one is missed, unused).
    patches: (K, 4, 4), two rows from (u, v, 1) to repetitions of the texture, the first one ending with
    texels per metre, then (tint, emission), then (first light-map texel, columns, rows, texture).
    texel_owner: (N, 3), primitive, face and patch of a light-map texel.
    texels: all mip levels of all textures, 8 bits a channel, as the square root of the linear colour.
    textures: (T, 3 + MAX_MIP_LEVELS), width, height, number of levels, start of each level.
    lights: (L, 5, 3), centre, edge_u, edge_v, normal, radiance.
    """

    primitives: NDArray[np.float32]
    nodes: NDArray[np.float32]
    patches: NDArray[np.float32]
    texel_owner: NDArray[np.int32]
    texels: NDArray[np.uint32]
    textures: NDArray[np.int32]
    lights: NDArray[np.float32]


def rotation(yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> NDArray[np.float64]:
    """3x3 rotation in degrees: roll about y, then pitch about x, then yaw about z."""
    a, b, c = np.radians([yaw, pitch, roll])
    rz = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    rx = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    ry = np.array([[np.cos(c), 0, np.sin(c)], [0, 1, 0], [-np.sin(c), 0, np.cos(c)]])
    return rz @ rx @ ry


def _affine(linear: NDArray[np.float64], shift: Vector) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = shift
    return matrix


@dataclass
class _Primitive:
    kind: int
    local_to_world: NDArray[np.float64]  # (4, 4)
    shape: tuple[float, float, float, float]
    materials: list[Material]

    def extent(self) -> NDArray[np.float64]:
        """Half sizes of the local bounding box."""
        if self.kind == ROUNDED:
            return np.array(self.shape[:3])
        if self.kind == FRUSTUM:
            widest = self.shape[0] + abs(self.shape[1])
            return np.array([widest, widest, 1.0])
        return np.ones(3)

    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) corners of the axis-aligned box in the world."""
        linear, centre = self.local_to_world[:3, :3], self.local_to_world[:3, 3]
        if self.kind == SPHERE:
            reach = np.linalg.norm(linear, axis=1)
        else:
            reach = np.abs(linear) @ self.extent()
        return np.stack([centre - reach, centre + reach])

    def face_size(self, face: int) -> tuple[float, float]:
        """Width and height of a patch in metres (of the widest line where they vary)."""
        scale = np.linalg.norm(self.local_to_world[:3, :3], axis=0) * self.extent()
        if self.kind in (BOX, ROUNDED):
            axis = face // 2
            across, down = (1 if axis == 0 else 0), (1 if axis == 2 else 2)
            return 2 * scale[across], 2 * scale[down]
        if self.kind == SPHERE:
            return 2 * np.pi * max(scale[0], scale[1]), np.pi * scale[2]
        if face == 0:
            return 2 * np.pi * scale[0], 2 * scale[2]
        radius = self.shape[0] + (self.shape[1] if face == 1 else -self.shape[1])
        ratio = radius / self.extent()[0]
        return max(2 * scale[0] * ratio, 1e-3), max(2 * scale[1] * ratio, 1e-3)


@dataclass
class Scene:
    """Collects primitives and lights; `arrays` turns them into tables.

    textures: (H, W, 3) uint8 sRGB images by name.
    """

    textures: Mapping[str, NDArray[np.uint8]]
    lights: list[Light] = field(default_factory=list)
    _primitives: list[_Primitive] = field(default_factory=list)
    _frame: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    @contextmanager
    def placed(self, at: Vector, turn: NDArray[np.float64] | float = 0.0) -> Iterator[None]:
        """Within this block, positions are relative to `at`, turned by a matrix or by degrees about z."""
        outer = self._frame
        linear = turn if isinstance(turn, np.ndarray) else rotation(turn)
        self._frame = outer @ _affine(linear, at)
        try:
            yield
        finally:
            self._frame = outer

    def box(
        self,
        at: Vector,
        size: Vector,
        material: Material,
        turn: NDArray[np.float64] | float = 0.0,
        **faces: Material,
    ) -> None:
        """A box centred on `at` with edge lengths `size`; x1=... dresses its +x face, x0=... of -x."""
        self._add(BOX, at, np.diag(np.asarray(size, float) / 2), turn, (0, 0, 0, 0), _pick(material, faces))

    def rounded(
        self,
        at: Vector,
        size: Vector,
        radius: float,
        material: Material,
        turn: NDArray[np.float64] | float = 0.0,
        **faces: Material,
    ) -> None:
        """A box with edges of `radius`, faces as for `box`."""
        half = np.asarray(size, float) / 2
        radius = min(radius, 0.999 * float(half.min()))
        self._add(ROUNDED, at, np.eye(3), turn, (*half, radius), _pick(material, faces))

    def ellipsoid(
        self, at: Vector, radii: Vector | float, material: Material, turn: NDArray[np.float64] | float = 0.0
    ) -> None:
        """An ellipsoid, or a sphere where `radii` is one number."""
        self._add(SPHERE, at, np.diag(np.broadcast_to(np.asarray(radii, float), 3)), turn, (0, 0, 0, 0), [material])

    def cylinder(
        self,
        at: Vector,
        radius: float,
        height: float,
        material: Material,
        turn: NDArray[np.float64] | float = 0.0,
        top_radius: float | None = None,
        top: Material | None = None,
    ) -> None:
        """A cylinder centred on `at` along its z axis, or a frustum where `top_radius` is another."""
        upper = 1.0 if top_radius is None else top_radius / radius
        shape = ((1 + upper) / 2, (upper - 1) / 2, 0.0, 0.0)
        materials = [material, top or material, material]
        self._add(FRUSTUM, at, np.diag([radius, radius, height / 2]), turn, shape, materials)

    def rod(
        self, start: Vector, end: Vector, radius: float, material: Material, end_radius: float | None = None
    ) -> None:
        """A cylinder from `start` to `end`."""
        a, b = np.asarray(start, float), np.asarray(end, float)
        z = (b - a) / np.linalg.norm(b - a)
        x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
        x /= np.linalg.norm(x)
        turn = np.stack([x, np.cross(z, x), z], axis=1)
        self.cylinder((a + b) / 2, radius, float(np.linalg.norm(b - a)), material, turn, end_radius)

    def _add(
        self,
        kind: int,
        at: Vector,
        stretch: NDArray[np.float64],
        turn: NDArray[np.float64] | float,
        shape: tuple[float, float, float, float],
        materials: list[Material],
    ) -> None:
        linear = turn if isinstance(turn, np.ndarray) else rotation(turn)
        for material in materials:
            if material.texture not in self.textures:
                raise ValueError(f"no texture named '{material.texture}'")
        self._primitives.append(_Primitive(kind, self._frame @ _affine(linear @ stretch, at), shape, materials))

    def arrays(self, texel: float) -> SceneArrays:
        """The tables, with about one light-map texel per `texel` metres."""
        nodes, order = _hierarchy(np.stack([p.bounds() for p in self._primitives]))
        primitives = [self._primitives[k] for k in order]
        names = {name: k for k, name in enumerate(self.textures)}
        texels, table = _mip_chains(list(self.textures.values()))

        rows = np.zeros((len(primitives), 8, 4), np.float32)
        patches, owners = [], []
        start = 0
        for k, p in enumerate(primitives):
            rows[k, 0:3] = np.linalg.inv(p.local_to_world)[:3]
            rows[k, 3:6] = p.local_to_world[:3]
            rows[k, 6] = p.shape
            rows[k, 7, :3] = p.kind, len(patches), p.materials[0].emission > 0
            for face, material in enumerate(p.materials):
                width, height = p.face_size(face)
                nu, nv = (int(np.clip(np.ceil(length / texel), 2, 256)) for length in (width, height))
                texture = names[material.texture]
                patches.append([*_look(material, width, height, table[texture]), (start, nu, nv, texture)])
                owners.append(np.tile(np.array([k, face, len(patches) - 1], np.int32), (nu * nv, 1)))
                start += nu * nv
        lights = [(s.centre, s.edge_u, s.edge_v, s.normal, s.radiance) for s in self.lights]
        return SceneArrays(
            primitives=rows,
            nodes=nodes,
            patches=np.array(patches, np.float32),
            texel_owner=np.concatenate(owners),
            texels=texels,
            textures=table,
            lights=np.array(lights, np.float32),
        )


def _pick(material: Material, faces: Mapping[str, Material]) -> list[Material]:
    names = ("x1", "x0", "y1", "y0", "z1", "z0")
    unknown = set(faces) - set(names)
    if unknown:
        raise ValueError(f"unknown faces {sorted(unknown)}, a box has {names}")
    return [faces.get(name, material) for name in names]


def _look(material: Material, width: float, height: float, texture: NDArray[np.int32]) -> NDArray[np.float64]:
    """Affine map of (u, v) to repetitions of the texture, texels per metre, tint and emission."""
    row = np.zeros((3, 4))
    if material.turned:
        width, height = height, width
    across, down = (1.0, 1.0) if material.repeat is None else (width / material.repeat[0], height / material.repeat[1])
    row[0, :3] = (0.0, across, material.offset[0]) if material.turned else (across, 0.0, material.offset[0])
    row[1, :3] = (-down, 0.0, material.offset[1] + down) if material.turned else (0.0, down, material.offset[1])
    row[0, 3] = np.sqrt(across * texture[0] / width * down * texture[1] / height)
    row[2] = (*material.tint, material.emission)
    return row


def _hierarchy(boxes: NDArray[np.float64]) -> tuple[NDArray[np.float32], list[int]]:
    """Bounding-volume hierarchy over (P, 2, 3) boxes, depth first.

    Each node knows the node to go to when it is missed, so that a loop without a stack walks the tree.
    Returns the table of nodes (M, 3, 4) and the order of the primitives in the leaves.
    """
    centres = boxes.mean(axis=1)
    nodes: list[NDArray[np.float64]] = []
    order: list[int] = []

    def area(lo: NDArray[np.float64], hi: NDArray[np.float64]) -> NDArray[np.float64]:
        d = hi - lo
        return d[:, 0] * d[:, 1] + d[:, 1] * d[:, 2] + d[:, 2] * d[:, 0]

    def split(members: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Surface-area heuristic over all sweeps of the three axes."""
        best = (np.inf, members[:1], members[1:])
        for axis in range(3):
            s = members[np.argsort(centres[members, axis], kind="stable")]
            lo, hi = boxes[s, 0], boxes[s, 1]
            left = area(np.minimum.accumulate(lo), np.maximum.accumulate(hi))[:-1]
            right = area(np.minimum.accumulate(lo[::-1]), np.maximum.accumulate(hi[::-1]))[::-1][1:]
            count = np.arange(1, len(s))
            cost = left * count + right * (len(s) - count)
            k = int(np.argmin(cost))
            if cost[k] < best[0]:
                best = (cost[k], s[: k + 1], s[k + 1 :])
        return best[1], best[2]

    def build(members: NDArray[np.int64]) -> None:
        row = np.zeros((3, 4))
        nodes.append(row)
        row[0, :3] = boxes[members, 0].min(axis=0) - 1e-4
        row[1, :3] = boxes[members, 1].max(axis=0) + 1e-4
        row[0, 3] = len(order)
        if len(members) <= LEAF_SIZE:
            row[1, 3] = len(members)
            order.extend(int(k) for k in members)
        else:
            for part in split(members):
                build(part)
        row[2, 0] = len(nodes)

    build(np.arange(len(boxes)))
    return np.array(nodes, np.float32), order


def _mip_chains(images: list[NDArray[np.uint8]]) -> tuple[NDArray[np.uint32], NDArray[np.int32]]:
    """All levels of all textures in one array, and the table of where each starts."""
    ramp = np.linspace(0.0, 1.0, 256)
    to_linear = np.where(ramp <= 0.04045, ramp / 12.92, ((ramp + 0.055) / 1.055) ** 2.4).astype(np.float32)
    pieces, start = [], 0
    table = np.zeros((len(images), 3 + MAX_MIP_LEVELS), np.int32)
    for k, image in enumerate(images):
        level = to_linear[image]
        height, width = image.shape[:2]
        table[k, :2] = width, height
        for n in range(MAX_MIP_LEVELS):
            w, h = max(1, width >> n), max(1, height >> n)
            if n > 0:
                level = cv2.resize(level, (w, h), interpolation=cv2.INTER_AREA).reshape(h, w, 3)
            code = np.rint(np.sqrt(level) * 255).astype(np.uint32)
            pieces.append((code[..., 0] | code[..., 1] << 8 | code[..., 2] << 16).ravel())
            table[k, 2] = n + 1
            table[k, 3 + n] = start
            start += w * h
            if w == 1 and h == 1:
                break
    return np.concatenate(pieces), table
