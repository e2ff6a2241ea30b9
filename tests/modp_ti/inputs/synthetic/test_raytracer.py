"""The kernels against plain float64 NumPy, on scenes with all kinds of primitives."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from modp_ti.inputs.synthetic import raytracer
from modp_ti.inputs.synthetic.scene import Light, Material, Scene, SceneArrays

pytestmark = pytest.mark.slow

GREY = Material("grey")
NO_SUN = np.array([[0, 0, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0]], np.float32)
QUADRANTS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)


def make_scene() -> Scene:
    return Scene(
        {
            "grey": np.full((4, 4, 3), 188, np.uint8),
            "quadrants": QUADRANTS.repeat(16, axis=0).repeat(16, axis=1),
        }
    )


def look(
    arrays: SceneArrays, origins: NDArray[np.float64], directions: NDArray[np.float64], light: float = 1.0
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colours and distances along rays, under the same light everywhere."""
    colour = np.empty((len(directions), 3), np.float32)
    distance = np.empty(len(directions), np.float32)
    raytracer.radiance(
        arrays.primitives,
        arrays.nodes,
        arrays.patches,
        arrays.texels,
        arrays.textures,
        np.full((len(arrays.texel_owner), 3), light, np.float32),
        NO_SUN,
        origins.astype(np.float32),
        directions.astype(np.float32),
        1e-4,
        1,
        colour,
        distance,
    )
    return colour, distance


# --------------------------------------------------------------------------------------------- the plain twin


def roots(a: float, b: float, c: float) -> list[float]:
    """Real and positive t with a t^2 + b t + c = 0."""
    under = b * b - 4 * a * c
    return [] if under < 0 else [t for t in ((-b - under**0.5) / (2 * a), (-b + under**0.5) / (2 * a)) if t > 0]


def hit_box(o: NDArray[np.float64], d: NDArray[np.float64], half: NDArray[np.float64]) -> float:
    """Face by face: where the ray meets the plane, and whether that is inside the face."""
    best = np.inf
    for axis, side in itertools.product(range(3), (-1, 1)):
        if d[axis] * side < 0:
            t = (side * half[axis] - o[axis]) / d[axis]
            others = [k for k in range(3) if k != axis]
            if t > 0 and all(abs(o[k] + t * d[k]) <= half[k] for k in others):
                best = min(best, t)
    return best


def hit_ball(o: NDArray[np.float64], d: NDArray[np.float64], centre: NDArray[np.float64], radius: float) -> float:
    p = o - centre
    return min(roots(d @ d, 2 * d @ p, p @ p - radius**2), default=np.inf)


def hit_cone(
    o: NDArray[np.float64], d: NDArray[np.float64], low: float, high: float, half: float, axis: int = 2
) -> float:
    """A frustum along an axis: radius `low` at -half, `high` at +half."""
    a, b = (k for k in range(3) if k != axis)
    slope, middle = (high - low) / (2 * half), (high + low) / 2
    r0, r1 = middle + slope * o[axis], slope * d[axis]
    around = roots(
        d[a] ** 2 + d[b] ** 2 - r1**2,
        2 * (o[a] * d[a] + o[b] * d[b] - r0 * r1),
        o[a] ** 2 + o[b] ** 2 - r0**2,
    )
    best = min((t for t in around if abs(o[axis] + t * d[axis]) <= half), default=np.inf)
    for z, radius in ((-half, low), (half, high)):
        t = (z - o[axis]) / d[axis]
        if t > 0 and np.hypot(o[a] + t * d[a], o[b] + t * d[b]) <= radius:
            best = min(best, t)
    return best


def hit_rounded(o: NDArray[np.float64], d: NDArray[np.float64], half: NDArray[np.float64], radius: float) -> float:
    """The union of three boxes, twelve rods along the edges and eight balls at the corners."""
    core = half - radius
    best = min(hit_box(o, d, core + radius * np.eye(3)[k]) for k in range(3))
    for corner in itertools.product((-1, 1), repeat=3):
        best = min(best, hit_ball(o, d, np.array(corner) * core, radius))
    for axis in range(3):
        for signs in itertools.product((-1, 1), repeat=2):
            centre = np.insert(np.array(signs, float), axis, 0.0) * core
            best = min(best, hit_cone(o - centre, d, radius, radius, core[axis], axis))
    return best


def test_distances_agree_with_plain_intersections_of_every_kind_of_primitive() -> None:
    rng = np.random.default_rng(1)
    scene = make_scene()
    twins = []
    for k in range(40):
        centre, size = rng.uniform(-2, 2, 3), rng.uniform(0.2, 0.9, 3)
        turn = Rotation.random(random_state=rng).as_matrix()
        if k % 4 == 0:
            scene.box(centre, size, GREY, turn)
            twins.append((centre, turn, lambda o, d, s=size: hit_box(o, d, s / 2)))
        elif k % 4 == 1:
            scene.ellipsoid(centre, size, GREY, turn)
            twins.append((centre, turn, lambda o, d, s=size: hit_ball(o / s, d / s, np.zeros(3), 1.0)))
        elif k % 4 == 2:
            scene.cylinder(centre, size[0], size[2], GREY, turn, top_radius=size[1])
            twins.append((centre, turn, lambda o, d, s=size: hit_cone(o, d, s[0], s[1], s[2] / 2)))
        else:
            scene.rounded(centre, size, 0.09, GREY, turn)
            twins.append((centre, turn, lambda o, d, s=size: hit_rounded(o, d, s / 2, 0.09)))

    origins = rng.normal(size=(200, 3))
    origins *= 6 / np.linalg.norm(origins, axis=1, keepdims=True)  # outside all of them
    directions = rng.uniform(-2, 2, origins.shape) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = np.array(
        [
            min(hit(turn.T @ (o - centre), turn.T @ d) for centre, turn, hit in twins)
            for o, d in zip(origins, directions, strict=True)
        ]
    )
    _, distance = look(scene.arrays(0.5), origins, directions)

    missed = np.isinf(expected)
    assert 20 < missed.sum() < 180, "the rays test neither hits nor misses"
    grazing = np.abs(distance - np.where(missed, 0, expected)) > 1e-3
    assert grazing.sum() <= 2, "a ray that touches an edge may go either way, no others"
    assert np.median(np.abs(distance - expected)[~missed & ~grazing]) < 1e-5


def test_a_texture_lies_on_a_face_as_a_reader_in_front_of_it_expects() -> None:
    scene = make_scene()
    scene.box((0, 0, 0), (2, 2, 2), GREY, y0=Material("quadrants"), x1=Material("quadrants"))
    arrays = scene.arrays(1.0)
    corners = np.array([[-0.5, 0.5], [0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])  # (right, up), as in the picture
    expected = QUADRANTS.reshape(4, 3) / 255

    front = np.stack([corners[:, 0], np.full(4, -3.0), corners[:, 1]], axis=1)
    colour, distance = look(arrays, front, np.tile([0.0, 1.0, 0.0], (4, 1)))
    np.testing.assert_allclose(colour, expected, atol=1e-5)
    np.testing.assert_allclose(distance, 2.0, atol=1e-5)

    right = np.stack([np.full(4, 3.0), corners[:, 0], corners[:, 1]], axis=1)
    colour, _ = look(arrays, right, np.tile([-1.0, 0.0, 0.0], (4, 1)))
    np.testing.assert_allclose(colour, expected, atol=1e-5)


def test_a_surface_shows_its_colour_times_the_light_on_it() -> None:
    scene = make_scene()
    scene.ellipsoid((0, 0, 0), 1.0, GREY)
    colour, _ = look(scene.arrays(0.5), np.array([[0.0, -3.0, 0.2]]), np.array([[0.0, 1.0, 0.0]]), light=0.7)
    linear = ((188 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(colour, 0.7 * linear, rtol=0.01)  # eight bits


def places_of(arrays: SceneArrays) -> NDArray[np.int32]:
    places = np.zeros(len(arrays.texel_owner), np.int32)
    raytracer.find_open_places(
        arrays.primitives, arrays.nodes, arrays.patches, arrays.texel_owner, [-9] * 3, [9] * 3, places
    )
    return places


def top_of_first_box(arrays: SceneArrays, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Light-map values (rows, columns, ...) of the +z face of the widest box: the floor."""
    sizes = [np.prod(patch[3, 1:3]) for patch in arrays.patches]
    widest = int(np.argmax(sizes))
    patch = widest if arrays.texel_owner[int(arrays.patches[widest, 3, 0]), 1] == 4 else widest - 1
    start, nu, nv = arrays.patches[patch, 3, :3].astype(int)
    return values[start : start + nu * nv].reshape(nv, nu, *values.shape[1:])


@pytest.mark.parametrize("blocked", [False, True])
def test_direct_light_falls_off_as_it_should_and_casts_shadows(blocked: bool) -> None:
    scene = make_scene()
    scene.box((0, 0, -0.1), (4, 4, 0.2), GREY)
    if blocked:
        scene.box((0, 0, 1.0), (0.5, 0.5, 0.05), GREY)
    side = 0.01
    scene.lights.append(Light((0, 0, 2), (side, 0, 0), (0, side, 0), (0, 0, 0), (3e4, 2e4, 1e4)))
    arrays = scene.arrays(0.2)
    light = np.zeros((len(arrays.texel_owner), 3), np.float32)
    raytracer.bake_direct(
        arrays.primitives,
        arrays.nodes,
        arrays.patches,
        arrays.texel_owner,
        places_of(arrays),
        arrays.lights,
        4,
        light,
    )
    floor = top_of_first_box(arrays, light)
    x = (np.arange(20) + 0.5) * 0.2 - 2
    u, v = np.meshgrid(x, -x)
    squared = u**2 + v**2 + 4
    expected = 3e4 * (2 * side) ** 2 / np.pi * (2 / np.sqrt(squared)) / squared
    shadow = (np.abs(u) < 0.45) & (np.abs(v) < 0.45)  # the plate at half the way casts twice its half size
    if blocked:
        lit = (np.abs(u) > 0.65) | (np.abs(v) > 0.65)
        assert (floor[shadow] == 0).all()
        np.testing.assert_allclose(floor[lit][:, 0], expected[lit], rtol=3e-3)
    else:
        np.testing.assert_allclose(floor[..., 0], expected, rtol=3e-3)
    np.testing.assert_allclose(floor[..., 2], floor[..., 0] / 3, rtol=1e-5)


def test_texels_under_another_body_are_hidden_unless_a_part_shows() -> None:
    scene = make_scene()
    scene.box((0, 0, -0.1), (4, 4, 0.2), GREY)
    scene.box((0, 0, 0.5), (1.1, 1.1, 1.0), GREY)
    arrays = scene.arrays(0.2)
    floor = top_of_first_box(arrays, places_of(arrays))
    x = (np.arange(20) + 0.5) * 0.2 - 2
    u, v = np.meshgrid(np.abs(x), np.abs(x))
    np.testing.assert_array_equal(floor < 0, (u < 0.45) & (v < 0.45))
    np.testing.assert_array_equal(floor > 0, (np.maximum(u, v) < 0.55) & (np.maximum(u, v) > 0.45))


def test_gathered_rays_are_distributed_as_the_cosine() -> None:
    scene = make_scene()
    scene.box((0, 0, 0), (2, 2, 2), GREY, Rotation.from_euler("x", 30, degrees=True).as_matrix())
    arrays = scene.arrays(0.5)
    count, side = len(arrays.texel_owner), 8
    origins, directions = np.zeros((2, count, 3), np.float32)
    total, largest = np.zeros((count, 3)), 0.0
    for sample in range(side * side):
        raytracer.gather_rays(
            arrays.primitives,
            arrays.patches,
            arrays.texel_owner,
            places_of(arrays),
            side,
            sample,
            origins,
            directions,
        )
        largest = max(largest, float(np.abs(np.linalg.norm(directions, axis=1) - 1).max()))
        total += directions
    normals = np.repeat(
        Rotation.from_euler("x", 30, degrees=True).apply(
            [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
        ),
        count // 6,
        axis=0,
    )
    assert largest < 1e-5
    np.testing.assert_allclose(total / side**2, 2 / 3 * normals, atol=0.04)  # the mean of the cosine lobe
