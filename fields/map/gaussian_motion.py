"""`GaussianMotion`: moves Gaussians with the views that placed them, and changes the colours of all."""
# pyright: reportGeneralTypeIssues=false, reportInvalidTypeForm=false, reportOperatorIssue=false, reportOptionalSubscript=false

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import quaternion_from_matrix, scale_of
from fields.map.gaussians import SH_C0, GaussianField
from fields.runtime.engine import ti

TABLE = ti.types.ndarray(ndim=2)
BLOCKS = ti.types.ndarray(ndim=3)


@ti.data_oriented
class GaussianMotion:
    """Applies one similarity per anchor to the anchor's Gaussians (position, rotation, scale, harmonics).

    Adam's moments are transformed as well, so that optimisation continues as if the Gaussian had always been at its new
    place. If a value changes by y = M x, its gradient changes by M^-T. First moments are multiplied by M^-T, and second
    moments by its squared elements, which assumes uncorrelated gradient components.
    """

    def __init__(self, gaussians: GaussianField) -> None:
        self.gaussians = gaussians

    def move(self, S: NDArray[np.float64], sh_rotation: NDArray[np.float64], first: int = 0) -> None:
        """Move every Gaussian from `first` on by the similarity of its anchor.

        Gaussians without an anchor, and those of an anchor whose similarity is the identity, stay bit-identical. The
        gradients of Gaussians that move are set to zero, so call this between steps.

        Args:
            S: Similarities S_after_before (A, 4, 4), one per anchor.
            sh_rotation: Matrices (A, K, K) that rotate the K harmonic coefficients.
            first: The first Gaussian.

        Raises:
            ValueError: If the anchor of a Gaussian is not a row of `S`.
        """
        g = self.gaussians
        if g.count == first:
            return
        if (largest := int(g.anchors(first).max())) >= len(S):
            raise ValueError(f"anchor {largest} has none of the {len(S)} motions")
        scale = scale_of(S)
        rotation = S[:, :3, :3] / scale[:, None, None]
        moves = (S != np.eye(4)).any(axis=(1, 2))
        quaternion = np.zeros((len(S), 4))
        for a in np.flatnonzero(moves):  # of thousands of anchors, often only the latest move
            quaternion[a] = quaternion_from_matrix(rotation[a])
        tables = (
            S[:, :3].reshape(-1, 12),
            rotation.reshape(-1, 9),
            quaternion,
            np.stack([np.log(scale), 1.0 / scale], axis=1),
            sh_rotation,
        )
        self._move(
            first, g.count, moves.astype(np.int32), *(np.ascontiguousarray(table, dtype=g.dtype) for table in tables)
        )

    def place(self, position: NDArray[np.float64], growth: float, first: int = 0) -> None:
        """Give the Gaussians new positions, and scale them. Moments stay, and gradients are set to zero.

        Args:
            position: New means (N, 3) of the Gaussians from `first` on, in the world frame.
            growth: Factor on their sizes.
            first: The first Gaussian.
        """
        self._place(first, np.ascontiguousarray(position, dtype=self.gaussians.dtype), float(np.log(growth)))
        self.gaussians.clear_gradients()

    def recolour(self, gain: NDArray[np.float64], offset: NDArray[np.float64], first: int = 0) -> None:
        """Turn the colours of the Gaussians from `first` on into gain (3,) colour + offset (3,), between steps."""
        if self.gaussians.count > first:
            table = np.ascontiguousarray([gain, offset], dtype=self.gaussians.dtype)
            self._recolour(first, self.gaussians.count, table)

    @ti.kernel
    def _recolour(self, first: ti.i32, end: ti.i32, table: TABLE):
        for i in range(first, end):
            for c in ti.static(range(3)):
                g = table[0, c]
                for k in range(self.gaussians.sh_count):
                    self.gaussians.sh[i, k][c] *= g
                    self.gaussians.sh_m[i, k][c] /= g
                    self.gaussians.sh_v[i, k][c] /= g * g
                # The colour is 0.5 + C0 sh_0 + ...
                self.gaussians.sh[i, 0][c] += (0.5 * (g - 1.0) + table[1, c]) / SH_C0

    @ti.kernel
    def _place(self, first: ti.i32, position: TABLE, growth: ti.f32):
        for i in range(position.shape[0]):
            for c in ti.static(range(3)):
                self.gaussians.position[first + i][c] = position[i, c]
                self.gaussians.log_scale[first + i][c] += growth

    @ti.kernel
    def _move(
        self,
        first: ti.i32,
        end: ti.i32,
        moves: ti.types.ndarray(dtype=ti.i32, ndim=1),
        linear: TABLE,  # (A, 12): the upper three rows of S
        rotations: TABLE,  # (A, 9)
        quaternions: TABLE,  # (A, 4)
        scales: TABLE,  # (A, 2): log s and 1 / s
        sh_rotation: BLOCKS,  # (A, K, K)
    ):
        for i in range(first, end):
            a = self.gaussians.anchor[i]
            if a >= 0 and moves[ti.max(a, 0)] != 0:
                self._move_geometry(i, a, linear, rotations, quaternions, scales)
                if ti.static(self.gaussians.sh_degree > 0):
                    self._turn_colour(i, a, sh_rotation)
                self.gaussians.touched[i] = 0
                self.gaussians.forget_gradient(i)

    @ti.func
    def _move_geometry(
        self, i, a, linear: ti.template(), rotations: ti.template(), quaternions: ti.template(), scales: ti.template()
    ):
        p, m, v = self.gaussians.position[i], self.gaussians.position_m[i], self.gaussians.position_v[i]
        for r in ti.static(range(3)):
            self.gaussians.position[i][r] = (
                linear[a, 4 * r] * p[0]
                + linear[a, 4 * r + 1] * p[1]
                + linear[a, 4 * r + 2] * p[2]
                + linear[a, 4 * r + 3]
            )
            # With y = s R x, a gradient g becomes R g / s.
            x, y, z = rotations[a, 3 * r], rotations[a, 3 * r + 1], rotations[a, 3 * r + 2]
            shrink = scales[a, 1]
            self.gaussians.position_m[i][r] = (x * m[0] + y * m[1] + z * m[2]) * shrink
            self.gaussians.position_v[i][r] = (x * x * v[0] + y * y * v[1] + z * z * v[2]) * shrink * shrink
            self.gaussians.log_scale[i][r] = self.gaussians.log_scale[i][r] + scales[a, 0]
        w = ti.Vector([quaternions[a, 0], quaternions[a, 1], quaternions[a, 2], quaternions[a, 3]])
        # Left multiplication by a unit quaternion is an orthogonal matrix, so that L^-T = L.
        L = ti.Matrix(
            [
                [w[0], -w[1], -w[2], -w[3]],
                [w[1], w[0], -w[3], w[2]],
                [w[2], w[3], w[0], -w[1]],
                [w[3], -w[2], w[1], w[0]],
            ]
        )
        self.gaussians.quaternion[i] = L @ self.gaussians.quaternion[i]
        self.gaussians.quaternion_m[i] = L @ self.gaussians.quaternion_m[i]
        self.gaussians.quaternion_v[i] = (L * L) @ self.gaussians.quaternion_v[i]

    @ti.func
    def _turn_colour(self, i, a, sh_rotation: ti.template()):
        self._turn(self.gaussians.sh, i, a, sh_rotation, False)
        self._turn(self.gaussians.sh_m, i, a, sh_rotation, False)
        self._turn(self.gaussians.sh_v, i, a, sh_rotation, True)

    @ti.func
    def _turn(self, field: ti.template(), i, a, sh_rotation: ti.template(), squared: ti.template()):
        """field[i] <- M field[i], with the gradient of `sh` as scratch space."""
        # The constant harmonic is invariant under rotation.
        for k in range(1, self.gaussians.sh_count):
            total = 0.0 * field[i, 0]
            for j in range(1, self.gaussians.sh_count):
                entry = sh_rotation[a, k, j]
                if ti.static(squared):
                    entry = entry * entry
                total += entry * field[i, j]
            self.gaussians.sh.grad[i, k] = total
        for k in range(1, self.gaussians.sh_count):
            field[i, k] = self.gaussians.sh.grad[i, k]
