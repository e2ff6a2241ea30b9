"""Adam steps of poses and exposures: on the host, and on a GPU without waiting for the device."""
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportInvalidTypeForm=false, reportOperatorIssue=false, reportOptionalCall=false
# pyright: reportOptionalOperand=false, reportOptionalSubscript=false

from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from fields.frames.tracked_frame import ImageLevel
from fields.geometry.camera import pixel_metric
from fields.geometry.se3 import orthonormalised
from fields.map.keyframe import Keyframe
from fields.runtime.backend import torch_device
from fields.runtime.compiled_kernel import CompiledKernel
from fields.runtime.engine import ti
from pipelines.companions.exposure import ExposureRefinement
from pipelines.optimise.adam import BOUND, Moments, bits, one_over_complement
from pipelines.optimise.poses import PoseRefinement
from pipelines.render.gpu.photometric import DevicePhotometric
from pipelines.render.gpu.projection import BLOCKS, DeviceProjection
from pipelines.render.renderer import Renderer


class Cameras:
    """Renders keyframes, and steps their poses and exposures.

    Args:
        renderer: Renderer of the map.
        poses: Steps of poses.
        exposure: Steps of exposures.
    """

    def __init__(self, renderer: Renderer, poses: PoseRefinement, exposure: ExposureRefinement) -> None:
        self.renderer, self.poses, self.exposure = renderer, poses, exposure
        self._gradients: dict[tuple[int, bool], list[NDArray[np.float64]]] = {}
        self._due: list[Callable[[], None]] = []

    def render(self, view: Keyframe, image: ImageLevel, near: float, exact: bool) -> None:
        """Render a keyframe at a level of its pyramid, with its exposure; see `Renderer.forward`."""
        self.renderer.forward(image.camera, view.T_camera_world, near, exact)
        self.renderer.develop(view.exposure, view.vignette)

    def step_pose(self, view: Keyframe, rate: float, is_last: bool) -> None:
        """Take in the gradient of the view that was rendered last, and step its pose if the batch has no more of it.

        On the CPU, steps are made by `move`.
        """
        if (gradient := self._total(view, False, self.renderer.camera_gradient(), is_last)) is not None:
            self._due.append(partial(self.poses.step, view, gradient, rate))

    def step_exposure(self, view: Keyframe, weight: float, is_last: bool) -> None:
        """The same for the exposure. weight: weight of the view in the loss, see `ExposureRefinement.step`."""
        if (gradient := self._total(view, True, self.renderer.exposure_gradient(), is_last)) is not None:
            self._due.append(partial(self.exposure.step, view, gradient, weight))

    def _total(self, view: Keyframe, of_exposure: bool, gradient: NDArray, is_last: bool) -> NDArray | None:
        """The sum of a batch's gradients, in order, if this is the last."""
        self._gradients.setdefault((view.index, of_exposure), []).append(gradient.astype(np.float64))
        return np.sum(self._gradients.pop((view.index, of_exposure)), axis=0) if is_last else None

    def move(self) -> None:
        """Make the steps of the last batch."""
        for step in self._due:
            step()
        self._due.clear()

    def settle(self) -> None:
        """Write the results of all steps to the keyframes. On a GPU, this waits for the device."""


# Numbers of a pose on the device, and where they begin: T_camera_world (3, 4) as rotation and translation, Adam's
# moments (6 each), the number of steps, that of steps undone, the sum of a batch's gradients (6), the tracked pose as
# the first, W of `pixel_metric` and its inverse (6, 6), and the square of the longest way from the tracked pose [px^2].
M, V, STEPS, CAUGHT, SUM, TRACKED, METRIC, INVERSE, FARTHEST = 12, 18, 24, 25, 26, 32, 44, 80, 116
# Numbers of an exposure: (A, b) (3, 4), the moments, the number of steps, that of steps left out, the sum.
E_M, E_V, E_STEPS, E_CAUGHT, E_SUM = 12, 24, 36, 37, 38

NUMBERS = ti.types.ndarray(dtype=ti.f32, ndim=1)
SUMS = ti.types.ndarray(dtype=ti.f32, ndim=2)


def _flat(T: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([T[:3, :3].ravel(), T[:3, 3]])


@ti.data_oriented
class DeviceCameras(Cameras):
    """Poses and exposures are stepped by kernels, in float32, and read by `settle`.

    Until then, the keyframes keep what they had at the first of these steps.
    """

    def __init__(self, renderer: Renderer, poses: PoseRefinement, exposure: ExposureRefinement) -> None:
        super().__init__(renderer, poses, exposure)
        assert isinstance(renderer.projection, DeviceProjection)
        assert isinstance(renderer.photometric, DevicePhotometric)
        self.projection, self.photometric = renderer.projection, renderer.photometric
        # By frame index: the keyframe's array that was sent, and its numbers on the device.
        self._poses: dict[int, tuple[NDArray, torch.Tensor]] = {}
        self._exposures: dict[int, tuple[NDArray, torch.Tensor]] = {}
        # Keyframes whose numbers have changed on the device.
        self._moved: dict[int, Keyframe] = {}
        self._exposed: dict[int, Keyframe] = {}
        self._pose_kernel, self._exposure_kernel = CompiledKernel(self._step_pose), CompiledKernel(self._step_exposure)
        self.log_betas = tuple(float(np.log(beta)) for beta in Moments.BETAS)

    def render(self, view: Keyframe, image: ImageLevel, near: float, exact: bool) -> None:
        T, stepped = view.T_camera_world, self._poses.get(view.index)
        pose = stepped[1][:12] if stepped is not None and stepped[0] is T else T
        self.renderer.forward(image.camera, pose, near, exact)
        self.renderer.develop(None if view.exposure is None else self._exposure(view)[:12], view.vignette)

    def step_pose(self, view: Keyframe, rate: float, is_last: bool) -> None:
        self._moved[view.index] = view
        self._pose_kernel(self._pose(view), self.projection.tangents, float(rate), int(is_last))

    def step_exposure(self, view: Keyframe, weight: float, is_last: bool) -> None:
        self._exposed[view.index] = view
        settings = self.exposure.settings
        pull = 2.0 * weight * settings.regularisation
        numbers = self._exposure(view), self.photometric.gradient
        self._exposure_kernel(*numbers, float(settings.learning_rate), float(pull), int(is_last))

    def settle(self) -> None:
        for views, table, end, read in (
            (self._moved, self._poses, SUM, self._read_pose),
            (self._exposed, self._exposures, E_SUM, self._read_exposure),
        ):
            if views:
                rows = torch.stack([table.pop(index)[1][:end] for index in views]).cpu().numpy()
                for view, row in zip(views.values(), rows.astype(np.float64), strict=True):
                    read(view, row)
                views.clear()

    def _read_pose(self, view: Keyframe, row: NDArray[np.float64]) -> None:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = row[:9].reshape(3, 3), row[9:12]
        view.T_camera_world = orthonormalised(T)
        self.poses.moments.put(view.index, row[M:V], row[V:STEPS], int(row[STEPS]))
        self.poses.safeguards.camera_steps += int(row[CAUGHT])

    def _read_exposure(self, view: Keyframe, row: NDArray[np.float64]) -> None:
        view.exposure = row[:E_M].reshape(3, 4)
        first, second = (row[at : at + 12].reshape(3, 4) for at in (E_M, E_V))
        self.exposure.moments.put(view.index, first, second, int(row[E_STEPS]))
        self.exposure.safeguards.exposure_steps += int(row[E_CAUGHT])

    def _pose(self, view: Keyframe) -> torch.Tensor:
        """The numbers of a keyframe's pose on the device, not of a copy at another level."""
        sent = self._poses.get(view.index)
        if sent is None or sent[0] is not view.T_camera_world:
            W = pixel_metric(view.camera, view.median_depth)
            farthest = self.poses.FARTHEST * np.hypot(view.camera.width, view.camera.height)
            parts = [_flat(view.T_camera_world), *self.poses.moments.of(view.index), np.zeros(7), _flat(view.T_tracked)]
            numbers = np.concatenate([*parts, W.ravel(), np.linalg.inv(W).ravel(), [farthest**2]])
            sent = self._poses[view.index] = view.T_camera_world, _sent(numbers)
        return sent[1]

    def _exposure(self, view: Keyframe) -> torch.Tensor:
        """The numbers of a keyframe's exposure on the device."""
        assert view.exposure is not None
        sent = self._exposures.get(view.index)
        if sent is None or sent[0] is not view.exposure:
            parts = [view.exposure.ravel(), *self.exposure.moments.of(view.index), np.zeros(13)]
            sent = self._exposures[view.index] = view.exposure, _sent(np.concatenate(parts))
        return sent[1]

    @ti.func
    def _adam(self, state: ti.template(), c, m, v, gradient, t):
        """Take in component c of a gradient, at step t. Returns the step for a rate of 1."""
        beta1, beta2 = ti.static(Moments.BETAS)
        log1, log2 = ti.static(self.log_betas)
        state[m + c] = beta1 * state[m + c] + (1.0 - beta1) * gradient
        state[v + c] = beta2 * state[v + c] + (1.0 - beta2) * gradient * gradient
        root = ti.sqrt(state[v + c] * one_over_complement(t * log2))
        return state[m + c] * one_over_complement(t * log1) / (root + 1e-15)

    @ti.kernel
    def _step_pose(self, state: NUMBERS, tangents: SUMS, rate: ti.f32, is_last: ti.i32):
        """See `PoseRefinement.step`."""
        self.projection.sum_tangents(tangents)
        for _ in range(1):
            total = 0.0
            for c in range(6):
                gradient = state[SUM + c]
                for block in range(BLOCKS):
                    gradient += tangents[block, c]
                state[SUM + c] = gradient
                total += ti.abs(gradient)
            if is_last == 1:
                if bits(total) < BOUND:
                    self._move(state, rate)
                else:
                    state[CAUGHT] = state[CAUGHT] + 1.0
                for c in range(6):
                    state[SUM + c] = 0.0

    @ti.func
    def _move(self, state: ti.template(), rate):
        state[STEPS] = state[STEPS] + 1.0
        xi = ti.Vector.zero(ti.f32, 6)
        for c in range(6):
            gradient = 0.0
            for r in range(6):
                gradient += state[METRIC + 6 * r + c] * state[SUM + r]
            u = -rate * self._adam(state, c, M, V, gradient, state[STEPS])
            for r in ti.static(range(6)):
                xi[r] += state[METRIC + 6 * r + c] * u
        rho, omega = ti.Vector([xi[0], xi[1], xi[2]]), ti.Vector([xi[3], xi[4], xi[5]])
        # exp(xi), whose coefficients are series for small angles.
        square = omega.dot(omega)
        angle = ti.sqrt(square)
        a, b, c = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
        if angle > 0.3:
            a, b = ti.sin(angle) / angle, (1.0 - ti.cos(angle)) / square
            c = (1.0 - a) / square
        w = ti.Matrix([[0.0, -omega[2], omega[1]], [omega[2], 0.0, -omega[0]], [-omega[1], omega[0], 0.0]])
        unit = ti.Matrix([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        R, t = self._rotation(state, 0), ti.Vector([state[9], state[10], state[11]])
        turn = unit + a * w + b * w @ w
        R, t = turn @ R, turn @ t + (unit + b * w + c * w @ w) @ rho
        # The rows of R stay orthonormal.
        x = ti.Vector([R[0, 0], R[0, 1], R[0, 2]]).normalized()
        y = ti.Vector([R[1, 0], R[1, 1], R[1, 2]])
        y = (y - x.dot(y) * x).normalized()
        z = x.cross(y)
        R = ti.Matrix.rows([x, y, z])
        if self._is_away(state, R, t):
            state[CAUGHT] = state[CAUGHT] + 1.0
            for k in range(M, CAUGHT):
                state[k] = 0.0
        else:
            for r in ti.static(range(3)):
                for k in ti.static(range(3)):
                    state[3 * r + k] = R[r, k]
                state[9 + r] = t[r]

    @ti.func
    def _rotation(self, state: ti.template(), at):
        R = ti.Matrix.zero(ti.f32, 3, 3)
        for r in ti.static(range(3)):
            for k in ti.static(range(3)):
                R[r, k] = state[at + 3 * r + k]
        return R

    @ti.func
    def _is_away(self, state: ti.template(), R, t):
        """Whether a pose is not finite, or too far from the tracked one, by a logarithm to third order."""
        before = ti.Vector([state[TRACKED + 9], state[TRACKED + 10], state[TRACKED + 11]])
        turn = R @ self._rotation(state, TRACKED).transpose()
        moved = t - turn @ before
        cosine = ti.sqrt(ti.max(1.0 + turn.trace(), 1e-12)) / 2.0
        vector = ti.Vector([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / (4.0 * cosine)
        sine = vector.norm()
        omega = vector * ti.select(sine > 1e-6, 2.0 * ti.atan2(sine, cosine) / ti.max(sine, 1e-6), 2.0)
        rho = moved - 0.5 * omega.cross(moved) + omega.cross(omega.cross(moved)) / 12.0
        way = 0.0
        for r in range(6):
            u = 0.0
            for k in ti.static(range(3)):
                u += state[INVERSE + 6 * r + k] * rho[k] + state[INVERSE + 6 * r + 3 + k] * omega[k]
            way += u * u
        return bits(way) > bits(state[FARTHEST])

    @ti.kernel
    def _step_exposure(self, state: NUMBERS, gradient: NUMBERS, rate: ti.f32, pull: ti.f32, is_last: ti.i32):
        """See `ExposureRefinement.step`."""
        for _ in range(1):
            total = 0.0
            for c in range(12):
                state[E_SUM + c] = state[E_SUM + c] + gradient[c]
                total += ti.abs(state[E_SUM + c])
            if is_last == 1:
                gain = (state[0] + state[5] + state[10]) / 3.0
                if bits(total) < BOUND:
                    state[E_STEPS] = state[E_STEPS] + 1.0
                    for c in range(12):
                        away = state[c] - ti.select(c % 5 == 0, gain, 0.0)
                        g = state[E_SUM + c] + pull * away
                        state[c] = state[c] - rate * self._adam(state, c, E_M, E_V, g, state[E_STEPS])
                else:
                    state[E_CAUGHT] = state[E_CAUGHT] + 1.0
                for c in range(12):
                    state[E_SUM + c] = 0.0


def _sent(numbers: NDArray[np.float64]) -> torch.Tensor:
    return torch.from_numpy(numbers.astype(np.float32)).to(torch_device(), non_blocking=True)


def make_cameras(renderer: Renderer, poses: PoseRefinement, exposure: ExposureRefinement) -> Cameras:
    """Make the form for the running device, which is that of the renderer."""
    form = DeviceCameras if isinstance(renderer.projection, DeviceProjection) else Cameras
    return form(renderer, poses, exposure)
