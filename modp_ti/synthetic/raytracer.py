"""Kernels of the demo room: rays against the scene tables, light-map baking, the radiance along rays.

Plain functions of NumPy arrays (`scene.SceneArrays`): nothing lives in Taichi between two calls, and the loops run over
table rows, so that the code stays small and compiles in seconds however much furniture there is.
"""

import taichi as ti
import taichi.math as tm

from modp_ti.synthetic.scene import BOX, FRUSTUM, ROUNDED, SPHERE

__all__ = ["bake_direct", "camera_rays", "find_open_places", "gather_rays", "radiance"]

FAR = 1e9
LONGEST = 100.0  # [m]
SURFACE = 1e-3  # [m] how far a secondary ray starts above the surface
MARCH_STEPS = 48

vec2 = ti.types.vector(2, ti.f32)
vec3 = ti.types.vector(3, ti.f32)
vec4 = ti.types.vector(4, ti.f32)
mat3 = ti.types.matrix(3, 3, ti.f32)

vec4_table = ti.types.ndarray(dtype=vec4, ndim=2)
vec3_table = ti.types.ndarray(dtype=vec3, ndim=2)
vec3_list = ti.types.ndarray(dtype=vec3, ndim=1)
int_table = ti.types.ndarray(dtype=ti.i32, ndim=2)
word_list = ti.types.ndarray(dtype=ti.u32, ndim=1)


@ti.func
def integer(x):
    """A whole number out of a table of floats (exact below 2^24)."""
    return ti.cast(x, ti.i32)


@ti.func
def map_point(primitives: ti.template(), k, row, p):
    """Rows `row` to `row + 2` of primitive k, an affine map, on a point."""
    q = vec4(p, 1.0)
    return vec3(primitives[k, row].dot(q), primitives[k, row + 1].dot(q), primitives[k, row + 2].dot(q))


@ti.func
def map_direction(primitives: ti.template(), k, row, d):
    """The linear part of the same map on a direction."""
    q = vec4(d, 0.0)
    return vec3(primitives[k, row].dot(q), primitives[k, row + 1].dot(q), primitives[k, row + 2].dot(q))


@ti.func
def reciprocal(d):
    """1 / d with axis-parallel components kept finite."""
    inverse = vec3(0.0)
    for i in ti.static(range(3)):
        inverse[i] = 1.0 / ti.select(ti.abs(d[i]) < 1e-9, ti.select(d[i] < 0, -1e-9, 1e-9), d[i])
    return inverse


@ti.func
def slab(o, inverse, lower, upper):
    """Entry and exit of a ray through an axis-aligned box."""
    a = (lower - o) * inverse
    b = (upper - o) * inverse
    return ti.min(a, b).max(), ti.max(a, b).min()


@ti.func
def rounded_distance(p, shape):
    """Signed distance to a box of half sizes shape.xyz with edges of radius shape.w."""
    q = ti.abs(p) - (shape.xyz - shape.w)
    return ti.max(q, 0.0).norm() + ti.min(q.max(), 0.0) - shape.w


@ti.func
def intersect(kind, shape, o, d):
    """Smallest positive ray parameter at which a local ray enters the unit shape, FAR if it does not."""
    t = FAR
    if kind == BOX:
        near, far = slab(o, reciprocal(d), vec3(-1.0), vec3(1.0))
        if 0.0 < near < far:
            t = near
    elif kind == SPHERE:
        a, b, c = d.dot(d), o.dot(d), o.dot(o) - 1.0
        root = b * b - a * c
        if root > 0.0:
            near = (-b - ti.sqrt(root)) / a
            if near > 0.0:
                t = near
    elif kind == FRUSTUM:
        radius, slope = shape.x + shape.y * o.z, shape.y * d.z
        a = d.xy.dot(d.xy) - slope * slope
        b = o.xy.dot(d.xy) - slope * radius
        c = o.xy.dot(o.xy) - radius * radius
        root = b * b - a * c
        if root > 0.0 and ti.abs(a) > 1e-12:
            for sign in range(2):
                s = (-b + (2.0 * sign - 1.0) * ti.sqrt(root)) / a
                z = o.z + s * d.z
                if 0.0 < s < t and ti.abs(z) <= 1.0 and shape.x + shape.y * z > 0.0:
                    t = s
        if ti.abs(d.z) > 1e-9:
            z = -tm.sign(d.z)
            s = (z - o.z) / d.z
            reach = shape.x + shape.y * z
            if 0.0 < s < t and (o.xy + s * d.xy).norm() <= reach:
                t = s
    else:
        near, far = slab(o, reciprocal(d), -shape.xyz, shape.xyz)
        if near < far and far > 0.0 and rounded_distance(o, shape) > 0.0:
            s = ti.max(near, 0.0)
            for _ in range(MARCH_STEPS):
                step = rounded_distance(o + s * d, shape)
                s += step
                if step < 1e-4 or s > far:
                    break
            if s < far:
                t = s
    return t


@ti.func
def trace(primitives: ti.template(), nodes: ti.template(), o, d, limit, shadow: ti.template()):
    """First primitive along a ray of unit direction within `limit` metres: (primitive or -1, distance).

    shadow: any hit will do, and shining surfaces let the ray pass, as they are no obstacles for their own light.
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
def inside(kind, shape, p):
    """Whether a local point lies in the unit shape."""
    result = False
    if kind == BOX:
        result = ti.abs(p).max() < 1.0
    elif kind == SPHERE:
        result = p.norm() < 1.0
    elif kind == FRUSTUM:
        result = ti.abs(p.z) < 1.0 and p.xy.norm() < shape.x + shape.y * p.z
    else:
        result = rounded_distance(p, shape) < 0.0
    return result


@ti.func
def chart(kind, shape, p):
    """Of a local surface point: (face, u, v, local normal)."""
    face, u, v, n = 0, 0.0, 0.0, vec3(0.0, 0.0, 1.0)
    if kind == SPHERE:
        n = p.normalized()
        u = ti.atan2(n.y, n.x) / (2.0 * tm.pi) + 0.5
        v = ti.acos(tm.clamp(n.z, -1.0, 1.0)) / tm.pi
    elif kind == FRUSTUM:
        across = p.xy.norm()
        if ti.abs(p.z) > 1.0 - 1e-4 and across < shape.x + shape.y * p.z - 1e-5:
            up = tm.sign(p.z)
            face = ti.select(p.z > 0, 1, 2)
            reach = shape.x + shape.y * up
            u, v, n = 0.5 + 0.5 * p.x / reach, 0.5 - 0.5 * up * p.y / reach, vec3(0.0, 0.0, up)
        else:
            u = ti.atan2(p.y, p.x) / (2.0 * tm.pi) + 0.5
            v = 0.5 - 0.5 * p.z
            n = vec3(p.xy / ti.max(across, 1e-9), -shape.y)
    else:
        half, q, size = vec3(1.0), p, ti.abs(p)
        if kind == ROUNDED:
            half = shape.xyz
            core = half - shape.w
            n = (p - tm.clamp(p, -core, core)).normalized()
            size = ti.abs(n)
            q = p - n * shape.w + n * (shape.w / size.max())
        axis = ti.select(size.x >= size.y and size.x >= size.z, 0, ti.select(size.y >= size.z, 1, 2))
        side = 1.0
        if axis == 0:
            side = tm.sign(p.x)
            u, v = 0.5 + 0.5 * side * q.y / half.y, 0.5 - 0.5 * q.z / half.z
        elif axis == 1:
            side = tm.sign(p.y)
            u, v = 0.5 - 0.5 * side * q.x / half.x, 0.5 - 0.5 * q.z / half.z
        else:
            side = tm.sign(p.z)
            u, v = 0.5 + 0.5 * side * q.x / half.x, 0.5 - 0.5 * q.y / half.y
        face = 2 * axis + ti.select(side > 0, 0, 1)
        if kind == BOX:
            n = vec3(0.0)
            n[axis] = side
    return face, u, v, n


@ti.func
def surface_point(kind, shape, face, u, v):
    """Inverse of `chart`: (local point, local normal) of (u, v) on a face."""
    p, n = vec3(0.0), vec3(0.0, 0.0, 1.0)
    if kind == SPHERE:
        angle, polar = (u - 0.5) * 2.0 * tm.pi, v * tm.pi
        p = vec3(ti.cos(angle) * ti.sin(polar), ti.sin(angle) * ti.sin(polar), ti.cos(polar))
        n = p
    elif kind == FRUSTUM:
        if face == 0:
            angle, z = (u - 0.5) * 2.0 * tm.pi, 1.0 - 2.0 * v
            around = vec2(ti.cos(angle), ti.sin(angle))
            p = vec3((shape.x + shape.y * z) * around, z)
            n = vec3(around, -shape.y)
        else:
            up = ti.select(face == 1, 1.0, -1.0)
            reach = shape.x + shape.y * up
            p = vec3(reach * (2.0 * u - 1.0), reach * (1.0 - 2.0 * v) * up, up)
            n = vec3(0.0, 0.0, up)
    else:
        half = ti.select(kind == ROUNDED, shape.xyz, vec3(1.0))
        axis = face // 2
        side = ti.select(face % 2 == 0, 1.0, -1.0)
        a, b = 2.0 * u - 1.0, 1.0 - 2.0 * v
        if axis == 0:
            p = vec3(side, side * a, b)
        elif axis == 1:
            p = vec3(-side * a, side, b)
        else:
            p = vec3(side * a, b, side)
        p *= half
        n = vec3(0.0)
        n[axis] = side
        if kind == ROUNDED:
            core = half - shape.w
            inner = tm.clamp(p, -core, core)
            n = (p - inner).normalized()
            p = inner + n * shape.w
    return p, n


@ti.func
def world_normal(primitives: ti.template(), k, n):
    """Local to world for normals: the transpose of the world-to-local map."""
    w = n.x * primitives[k, 0].xyz + n.y * primitives[k, 1].xyz + n.z * primitives[k, 2].xyz
    return w.normalized()


@ti.func
def texel_colour(texels: ti.template(), start, width, height, x, y):
    """Linear colour of one texel, repeated in both directions."""
    code = texels[start + (y % height) * width + x % width]
    root = vec3(
        ti.cast(code & 255, ti.f32), ti.cast((code >> 8) & 255, ti.f32), ti.cast((code >> 16) & 255, ti.f32)
    )
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

    sun: rows direction to the sun, colour, lower corner and upper corner of the window in its plane x = const.
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
    """Radiance that leaves primitive k at world point p. spread: width of the ray there [m]. seen: show light sources."""
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
    """World point and normal of a light-map texel, at one of nine places in it: 0 is its middle, the others lie around."""
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
                if k != own and inside(
                    integer(primitives[k, 7].x), primitives[k, 6], map_point(primitives, k, 0, p)
                ):
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
    places: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,), written
):
    """Where in each texel its light is measured: the first place that is not inside another primitive, -1 where all are.

    Texels outside the box of interest get -1 too.
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
    places: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (N,), of `find_open_places`
    lights: vec3_table,  # (L, 5)
    side: ti.i32,
    light: vec3_list,  # (N,), written
):
    """Light that the area lights send to each texel, over pi: what a white surface shows. side^2 stratified shadow rays each."""
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
    places: ti.types.ndarray(dtype=ti.i32, ndim=1),
    side: ti.i32,
    sample: ti.i32,
    origins: vec3_list,  # (N,), written
    directions: vec3_list,  # (N,), written; zero for texels without a place
):
    """One ray from each texel: number `sample` of side^2 that are distributed over the hemisphere as the cosine."""
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
    distance: ti.types.ndarray(dtype=ti.f32, ndim=1),  # (R,), written; 0 where nothing is hit
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
