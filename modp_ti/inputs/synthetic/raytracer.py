"""Kernels of the demo room: rays against the scene tables, light-map baking, the radiance along rays.

Plain functions of NumPy arrays (`scene.SceneArrays`): nothing lives in Taichi between two calls, and loops
run over table rows, so that the code stays small and compiles in seconds however much furniture there is.

No `from __future__ import annotations` here: Taichi reads the annotations of kernels as objects.
"""

import taichi as ti
import taichi.math as tm

from modp_ti.inputs.synthetic.scene import FRUSTUM, SPHERE
from modp_ti.inputs.synthetic.shapes import (
    chart,
    inside,
    integer,
    intersect,
    map_direction,
    map_point,
    reciprocal,
    slab,
    surface_point,
    vec2,
    vec3,
    vec4,
    world_normal,
)

__all__ = ["bake_direct", "camera_rays", "find_open_places", "gather_rays", "radiance"]

LONGEST = 100.0  # [m] of a ray
SURFACE = 1e-3  # [m] how far a secondary ray starts above the surface

mat3 = ti.types.matrix(3, 3, ti.f32)
vec4_table = ti.types.ndarray(dtype=vec4, ndim=2)
vec3_table = ti.types.ndarray(dtype=vec3, ndim=2)
vec3_list = ti.types.ndarray(dtype=vec3, ndim=1)
int_table = ti.types.ndarray(dtype=ti.i32, ndim=2)
int_list = ti.types.ndarray(dtype=ti.i32, ndim=1)
float_list = ti.types.ndarray(dtype=ti.f32, ndim=1)
word_list = ti.types.ndarray(dtype=ti.u32, ndim=1)


@ti.func
def trace(primitives: ti.template(), nodes: ti.template(), o, d, limit, shadow: ti.template()):
    """First primitive along a ray of unit direction within `limit` metres: (primitive or -1, distance).

    shadow: any hit will do, and shining surfaces let the ray pass: they are no obstacle for their own light.
    """
    inverse = reciprocal(d)
    hit, best = -1, limit
    node = 0
    end = nodes.shape[0]
    while node < end:
        near, far = slab(o, inverse, nodes[node, 0].xyz, nodes[node, 1].xyz)
        if near <= far and far > 0.0 and near < best:
            first = integer(nodes[node, 0].w)
            for k in range(first, first + integer(nodes[node, 1].w)):
                about = primitives[k, 7]
                if not (shadow and about.z > 0.0):
                    t = intersect(
                        integer(about.x),
                        primitives[k, 6],
                        map_point(primitives, k, 0, o),
                        map_direction(primitives, k, 0, d),
                    )
                    if t < best:
                        best, hit = t, k
            node = ti.select(shadow and hit >= 0, end, node + 1)
        else:
            node = integer(nodes[node, 2].x)
    return hit, best


@ti.func
def texel_colour(texels: ti.template(), start, width, height, x, y):
    """Linear colour of one texel, repeated in both directions."""
    code = texels[start + (y % height) * width + x % width]
    root = vec3(ti.cast(code & 255, ti.f32), ti.cast((code >> 8) & 255, ti.f32), ti.cast((code >> 16) & 255, ti.f32))
    root /= 255.0
    return root * root


@ti.func
def sample_texture(texels: ti.template(), textures: ti.template(), index, u, v, footprint):
    """Linear colour at (u, v) in repetitions, bilinear in the mip level that fits a footprint in texels."""
    level = ti.cast(ti.max(ti.log(ti.max(footprint, 1e-6)) / ti.log(2.0) + 0.5, 0.0), ti.i32)
    level = ti.min(level, textures[index, 2] - 1)
    width, height = ti.max(textures[index, 0] >> level, 1), ti.max(textures[index, 1] >> level, 1)
    start = textures[index, 3 + level]
    x, y = (u - ti.floor(u)) * width - 0.5, (v - ti.floor(v)) * height - 0.5
    x0, y0 = ti.cast(ti.floor(x), ti.i32), ti.cast(ti.floor(y), ti.i32)
    fx, fy = x - x0, y - y0
    x0, y0 = x0 + width, y0 + height  # -1 becomes the last texel under the modulo
    colour = vec3(0.0)
    for j in range(2):
        for i in range(2):
            weight = ti.select(i == 0, 1.0 - fx, fx) * ti.select(j == 0, 1.0 - fy, fy)
            colour += weight * texel_colour(texels, start, width, height, x0 + i, y0 + j)
    return colour


@ti.func
def sample_light(light: ti.template(), start, nu, nv, u, v, around):
    """Baked light at (u, v) of a patch, bilinear; `around` joins its left and right edge."""
    x, y = u * nu - 0.5, v * nv - 0.5
    x0, y0 = ti.cast(ti.floor(x), ti.i32), ti.cast(ti.floor(y), ti.i32)
    fx, fy = x - x0, y - y0
    total = vec3(0.0)
    for j in range(2):
        for i in range(2):
            column = ti.select(around, (x0 + i + nu) % nu, tm.clamp(x0 + i, 0, nu - 1))
            row = tm.clamp(y0 + j, 0, nv - 1)
            weight = ti.select(i == 0, 1.0 - fx, fx) * ti.select(j == 0, 1.0 - fy, fy)
            total += weight * light[start + row * nu + column]
    return total


@ti.func
def sunlight(primitives: ti.template(), nodes: ti.template(), sun: ti.template(), p, n):
    """Direct sun on a surface point; zero unless the way to the sun goes through the window.

    sun: rows direction to the sun, colour, lower and upper corner of the window in its plane x = const.
    """
    result = vec3(0.0)
    facing = n.dot(sun[0])
    t = (sun[2].x - p.x) / sun[0].x
    at = p + t * sun[0]
    if facing > 0.0 and t > 0.0 and sun[2].y < at.y < sun[3].y and sun[2].z < at.z < sun[3].z:
        hit, _ = trace(primitives, nodes, p + SURFACE * n, sun[0], 20.0, True)
        if hit < 0:
            result = facing * sun[1]
    return result


@ti.func
def shade(
    primitives: ti.template(),
    nodes: ti.template(),
    patches: ti.template(),
    texels: ti.template(),
    textures: ti.template(),
    light: ti.template(),
    sun: ti.template(),
    k,
    p,
    spread,
    seen,
):
    """Radiance that leaves primitive k at world point p.

    spread: width of the ray there [m]. seen: whether light sources show.
    """
    kind = integer(primitives[k, 7].x)
    face, u, v, n = chart(kind, primitives[k, 6], map_point(primitives, k, 0, p))
    patch = integer(primitives[k, 7].y) + face
    across, down, tint, about = patches[patch, 0], patches[patch, 1], patches[patch, 2], patches[patch, 3]
    s, t = across.x * u + across.y * v + across.z, down.x * u + down.y * v + down.z
    colour = tint.xyz * sample_texture(texels, textures, integer(about.w), s, t, spread * across.w)
    if tint.w > 0.0:
        colour *= ti.select(seen, tint.w, 0.0)
    else:
        around = (kind == SPHERE or kind == FRUSTUM) and face == 0
        baked = sample_light(light, integer(about.x), integer(about.y), integer(about.z), u, v, around)
        colour *= baked + sunlight(primitives, nodes, sun, p, world_normal(primitives, k, n))
    return colour


@ti.func
def scramble(x):
    """A 32-bit integer hash (PCG)."""
    s = ti.cast(x, ti.u32) * ti.u32(747796405) + ti.u32(2891336453)
    w = ((s >> ((s >> 28) + 4)) ^ s) * ti.u32(277803737)
    return (w >> 22) ^ w


@ti.func
def random_pair(seed):
    """Two numbers in [0, 1), a function of the seed alone."""
    a = scramble(seed)
    b = scramble(a)
    return vec2(ti.cast(a >> 8, ti.f32), ti.cast(b >> 8, ti.f32)) / 16777216.0


@ti.func
def texel_surface(primitives: ti.template(), patches: ti.template(), owner: ti.template(), texel, place):
    """World point and normal of a light-map texel, at one of nine places in it: 0 is its middle."""
    k, face, patch = owner[texel, 0], owner[texel, 1], owner[texel, 2]
    about = patches[patch, 3]
    cell, nu, nv = texel - integer(about.x), integer(about.y), integer(about.z)
    column, row = (place + 1) % 3, (place // 3 + 1) % 3  # 0, 1, 2 for low, middle, high; both 1 at place 0
    u = (cell % nu + 0.5 + 0.42 * (column - 1)) / nu
    v = (cell // nu + 0.5 + 0.42 * (row - 1)) / nv
    p, n = surface_point(integer(primitives[k, 7].x), primitives[k, 6], face, u, v)
    return map_point(primitives, k, 3, p), world_normal(primitives, k, n)


@ti.func
def inside_another(primitives: ti.template(), nodes: ti.template(), own, p):
    """Whether p lies in a primitive other than `own`."""
    found = False
    node = 0
    while node < nodes.shape[0]:
        if (p >= nodes[node, 0].xyz).all() and (p <= nodes[node, 1].xyz).all():
            first = integer(nodes[node, 0].w)
            for k in range(first, first + integer(nodes[node, 1].w)):
                if k != own and inside(integer(primitives[k, 7].x), primitives[k, 6], map_point(primitives, k, 0, p)):
                    found = True
            node = ti.select(found, nodes.shape[0], node + 1)
        else:
            node = integer(nodes[node, 2].x)
    return found


@ti.kernel
def find_open_places(
    primitives: vec4_table,  # (P, 8)
    nodes: vec4_table,  # (M, 3)
    patches: vec4_table,  # (K, 4)
    owner: int_table,  # (N, 3)
    lower: vec3,
    upper: vec3,
    places: int_list,  # (N,), written
):
    """Where in each texel its light is measured: the first place that is not inside another primitive.

    It is -1 where all are, and for texels outside the box from `lower` to `upper`.
    """
    for texel in range(places.shape[0]):
        found = -1
        for place in range(9):
            if found < 0:
                at, normal = texel_surface(primitives, patches, owner, texel, place)
                p = at + 4.0 * SURFACE * normal
                if (
                    (p >= lower).all()
                    and (p <= upper).all()
                    and not inside_another(primitives, nodes, owner[texel, 0], p)
                ):
                    found = place
        places[texel] = found


@ti.kernel
def bake_direct(
    primitives: vec4_table,
    nodes: vec4_table,
    patches: vec4_table,
    owner: int_table,
    places: int_list,  # (N,), of `find_open_places`
    lights: vec3_table,  # (L, 5)
    side: ti.i32,
    light: vec3_list,  # (N,), written
):
    """Light that the area lights send to each texel, over pi: what a white surface shows.

    side^2 shadow rays go to strata of each light.
    """
    for texel in range(light.shape[0]):
        total = vec3(0.0)
        if places[texel] >= 0:
            at, normal = texel_surface(primitives, patches, owner, texel, places[texel])
            start = at + SURFACE * normal
            for j in range(lights.shape[0]):
                area = 4.0 * lights[j, 1].cross(lights[j, 2]).norm()
                arriving = 0.0
                for s in range(side * side):
                    r = random_pair((texel * 8 + j) * 1024 + s)
                    a = 2.0 * (s % side + r.x) / side - 1.0
                    b = 2.0 * (s // side + r.y) / side - 1.0
                    way = lights[j, 0] + a * lights[j, 1] + b * lights[j, 2] - start
                    distance = way.norm()
                    d = way / distance
                    shining = 1.0
                    if lights[j, 3].norm() > 0.5:
                        shining = -d.dot(lights[j, 3])
                    facing = d.dot(normal)
                    if facing > 0.0 and shining > 0.0:
                        hit, _ = trace(primitives, nodes, start, d, distance - SURFACE, True)
                        if hit < 0:
                            # Nearer than 10 cm the square law would show single samples as spots.
                            arriving += facing * shining / ti.max(distance * distance, 0.01)
                total += arriving * area / (side * side * tm.pi) * lights[j, 4]
        light[texel] = total


@ti.kernel
def gather_rays(
    primitives: vec4_table,
    patches: vec4_table,
    owner: int_table,
    places: int_list,
    side: ti.i32,
    sample: ti.i32,
    origins: vec3_list,  # (N,), written
    directions: vec3_list,  # (N,), written; zero for texels without a place
):
    """One ray from each texel: number `sample` of side^2 that follow the cosine over the hemisphere."""
    for texel in range(origins.shape[0]):
        directions[texel] = vec3(0.0)
        if places[texel] >= 0:
            at, normal = texel_surface(primitives, patches, owner, texel, places[texel])
            helper = ti.select(ti.abs(normal.z) < 0.9, vec3(0.0, 0.0, 1.0), vec3(1.0, 0.0, 0.0))
            tangent = helper.cross(normal).normalized()
            bitangent = normal.cross(tangent)
            r = random_pair(texel * 1024 + sample + 7)
            angle, height = 2.0 * tm.pi * (sample % side + r.x) / side, (sample // side + r.y) / side
            flat = ti.cos(angle) * tangent + ti.sin(angle) * bitangent
            directions[texel] = ti.sqrt(height) * flat + ti.sqrt(1.0 - height) * normal
            origins[texel] = at + SURFACE * normal


@ti.kernel
def camera_rays(
    rotation: mat3,  # camera to world
    focal: vec2,
    principal: vec2,
    offset: vec2,  # where in its pixel each ray passes
    directions: vec3_table,  # (H, W), written; unit length, in the world
):
    """One ray through each pixel."""
    for y, x in ti.ndrange(directions.shape[0], directions.shape[1]):
        at = (vec2(x, y) + offset - principal) / focal
        directions[y, x] = rotation @ vec3(at, 1.0).normalized()


@ti.kernel
def radiance(
    primitives: vec4_table,
    nodes: vec4_table,
    patches: vec4_table,
    texels: word_list,
    textures: int_table,  # (T, 15)
    light: vec3_list,  # (N,), the light map
    sun: vec3_list,  # (4,), as `sunlight` takes it
    origins: vec3_list,  # (R,), or one for all
    directions: vec3_list,  # (R,), unit length or zero for no ray
    width: ti.f32,  # of the rays at a distance of 1 m: the texture detail that they take in
    seen: ti.i32,  # whether they see the light sources themselves
    colour: vec3_list,  # (R,), written: linear, not exposed
    distance: float_list,  # (R,), written; 0 where nothing is hit
):
    """What comes along each ray."""
    for i in range(directions.shape[0]):
        d = directions[i]
        o = origins[ti.min(i, origins.shape[0] - 1)]
        total, length = vec3(0.0), 0.0
        if d.dot(d) > 0.0:
            k, t = trace(primitives, nodes, o, d, LONGEST, False)
            if k >= 0:
                length = t
                total = shade(
                    primitives,
                    nodes,
                    patches,
                    texels,
                    textures,
                    light,
                    sun,
                    k,
                    o + t * d,
                    width * t,
                    seen != 0,
                )
        colour[i], distance[i] = total, length
