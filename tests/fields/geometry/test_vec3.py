import numpy as np
from numpy.testing import assert_allclose

from fields.geometry.vec3 import cross, dot, rotate, rotate_back
from fields.runtime.engine import ti


def test_products_are_those_of_numpy() -> None:
    @ti.kernel
    def products(m: ti.types.ndarray(), a: ti.types.ndarray(), b: ti.types.ndarray(), out: ti.types.ndarray()):
        for _ in range(1):
            M = ti.Matrix([[m[r, c] for c in range(3)] for r in range(3)])
            u, v = ti.Vector([a[0], a[1], a[2]]), ti.Vector([b[0], b[1], b[2]])
            w, forth, back = cross(u, v), rotate(M, u), rotate_back(M, u)
            for c in ti.static(range(3)):
                out[0, c], out[1, c], out[2, c] = w[c], forth[c], back[c]
            out[3, 0] = dot(u, v)

    rng = np.random.default_rng(0)
    m, a, b = rng.normal(size=(3, 3)), rng.normal(size=3), rng.normal(size=3)
    out = np.zeros((4, 3))
    products(m, a, b, out)
    assert_allclose(out[0], np.cross(a, b), atol=1e-14)
    assert_allclose(out[1], m @ a, atol=1e-14)
    assert_allclose(out[2], m.T @ a, atol=1e-14)
    assert_allclose(out[3, 0], a @ b, atol=1e-14)
