"""Products of 3-vectors as single expressions, and rotations, for differentiated kernels.

Taichi's own `@` and `dot` accumulate into a mutable local variable. Reverse-mode differentiation keeps every state of
such a variable on a stack, which made the gradient of the projection three times slower.
"""

from fields.runtime.engine import ti


@ti.func
def dot(a, b):
    """Inner product of two 3-vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@ti.func
def cross(a, b):
    """Cross product of two 3-vectors."""
    return ti.Vector([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@ti.func
def rotate(m, v):
    """m @ v for a 3x3 matrix."""
    return ti.Vector(
        [
            m[0, 0] * v[0] + m[0, 1] * v[1] + m[0, 2] * v[2],
            m[1, 0] * v[0] + m[1, 1] * v[1] + m[1, 2] * v[2],
            m[2, 0] * v[0] + m[2, 1] * v[1] + m[2, 2] * v[2],
        ]
    )


@ti.func
def rotate_back(m, v):
    """m.transpose() @ v for a 3x3 matrix."""
    return ti.Vector(
        [
            m[0, 0] * v[0] + m[1, 0] * v[1] + m[2, 0] * v[2],
            m[0, 1] * v[0] + m[1, 1] * v[1] + m[2, 1] * v[2],
            m[0, 2] * v[0] + m[1, 2] * v[1] + m[2, 2] * v[2],
        ]
    )


@ti.func
def rotation_from_quaternion(q):
    """Rotation matrix of a quaternion (w, x, y, z) of any length but zero."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return ti.Matrix(
        [
            [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
        ]
    )
