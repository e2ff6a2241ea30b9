"""Taichi functions of the unit shapes that `scene` describes: where a ray meets them, and their charts."""

import taichi as ti
import taichi.math as tm

from modp_ti.inputs.synthetic.scene import BOX, FRUSTUM, ROUNDED, SPHERE

__all__ = [
    "FAR",
    "chart",
    "inside",
    "integer",
    "intersect",
    "map_direction",
    "map_point",
    "reciprocal",
    "slab",
    "surface_point",
    "vec2",
    "vec3",
    "vec4",
    "world_normal",
]

FAR = 1e9  # [m] where a ray that meets nothing ends
MARCH_STEPS = 48

vec2 = ti.types.vector(2, ti.f32)
vec3 = ti.types.vector(3, ti.f32)
vec4 = ti.types.vector(4, ti.f32)


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
