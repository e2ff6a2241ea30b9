"""What the stages of the CPU and of a GPU share: the formulas of splatting, and the buffers of the photometric model.

EWA splatting [Zwicker 2001] with the opacity compensation of Mip-Splatting [Yu 2024].
"""
# pyright: reportArgumentType=false, reportIndexIssue=false, reportInvalidTypeForm=false, reportOptionalSubscript=false

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fields.buffers.images import PAD, ImageBuffers
from fields.buffers.view import ProjectedGaussians, ViewField
from fields.geometry.vec3 import cross, dot, rotate, rotate_back, rotation_from_quaternion
from fields.map.gaussians import SH_C0, GaussianField
from fields.runtime.backend import refuse_too_many_fields
from fields.runtime.engine import ti
from pipelines.render.spherical_harmonics import evaluate_sh

# Variance of the pixel's footprint, added to every ellipse [px^2].
BLUR = 0.3
# Contributions below this are not drawn, as in other splatting renderers.
ALPHA_MIN = 1.0 / 255.0
MIN_LOGIT = float(np.log(ALPHA_MIN / (1.0 - ALPHA_MIN)))
# Distance from the centre of an opaque Gaussian at which its contribution falls to ALPHA_MIN [standard deviations].
MAX_REACH = float(np.sqrt(-2.0 * np.log(ALPHA_MIN)))
# Lower bound of the compensation's determinant ratio. Below it, a Gaussian is far thinner than a pixel, and the
# gradient would be infinite.
MIN_DETERMINANT_RATIO = 1e-6
# Margin around an ellipse [px], far above rounding errors and far below a pixel.
SLACK = 0.01
ALPHA_MAX = 0.99
# A tile stops once the transmittance is below this at all of its pixels, which affects neither 8 bits nor the tests.
OPAQUE = 1e-5
# The exposure (A, b) (3, 4) that changes nothing.
IDENTITY = np.eye(3, 4)
IDENTITY.flags.writeable = False


@ti.data_oriented
class ProjectionFormulas:
    """Visibility, ellipse and colour of one Gaussian in the view in `view`, differentiable by Taichi.

    Attributes:
        tangent: Camera tangents xi = 0 (6), whose gradients add up to that of the pose.
    """

    def __init__(
        self, gaussians: GaussianField, view: ViewField, projected: ProjectedGaussians, tangent: ti.MatrixField
    ) -> None:
        self.gaussians = gaussians
        self.view = view
        self.projected = projected
        self.tangent = tangent

    @ti.func
    def _camera(self):
        """The view's T_camera_world (3, 4), and an upper bound on the stretch of its linearised projection."""
        rotation, translation = self.view.rotation[None], self.view.translation[None]
        focal, limits = self.view.focal[None], self.view.limits[None]
        camera = ti.Matrix.zero(self.projected.real, 3, 4)
        for r in ti.static(range(3)):
            for c in ti.static(range(3)):
                camera[r, c] = rotation[r, c]
            camera[r, 3] = translation[r]
        # |rows of J| <= f / z * sqrt(1 + limit^2).
        bound = ti.max(ti.max(-limits[0], limits[1]), ti.max(-limits[2], limits[3]))
        return camera, ti.max(focal[0], focal[1]) * ti.sqrt(1.0 + bound * bound)

    @ti.func
    def _seen_at(self, i, camera, stretch):
        """Depth (float32) of Gaussian i if the view may see it, else 0. camera, stretch: from `_camera`."""
        focal, centre, size = self.view.focal[None], self.view.centre[None], self.view.size[None]
        position = self.gaussians.position[i]
        p = camera @ ti.Vector([position[0], position[1], position[2], ti.cast(1.0, self.projected.real)])
        visible = 0
        if p.z > self.view.near[None] and self.gaussians.opacity_logit[i] > MIN_LOGIT:
            inv_z = 1.0 / p.z
            sigma = ti.exp(self.gaussians.log_scale[i].max()) * stretch * inv_z
            # The reach of an opaque Gaussian: the exact one would cost an exponential and a logarithm more.
            radius = MAX_REACH * ti.sqrt(sigma * sigma + BLUR)
            x = focal[0] * p.x * inv_z + centre[0]
            y = focal[1] * p.y * inv_z + centre[1]
            if x + radius > 0.0 and x - radius < size[0] and y + radius > 0.0 and y - radius < size[1]:
                visible = 1
        return ti.select(visible == 1, ti.cast(p.z, ti.f32), 0.0)

    @ti.func
    def _project_one(self, i, s, t):
        """Project Gaussian i to slot s, with the camera tangent t."""
        xi = self.tangent[t]
        rho, omega = ti.Vector([xi[0], xi[1], xi[2]]), ti.Vector([xi[3], xi[4], xi[5]])
        W = self.view.rotation[None]
        focal, limits = self.view.focal[None], self.view.limits[None]

        # exp(xi) to first order, whose value and derivative are exact at xi = 0.
        tracked = rotate(W, self.gaussians.position[i]) + self.view.translation[None]
        p = tracked + cross(omega, tracked) + rho
        inv_z = 1.0 / p[2]
        tx, ty = p[0] * inv_z, p[1] * inv_z
        # Rows of the Jacobian of the pixel position, linearised inside the frustum's margin.
        jx = -ti.min(ti.max(tx, limits[0]), limits[1])
        jy = -ti.min(ti.max(ty, limits[2]), limits[3])
        row_x = ti.Vector([1.0, 0.0, jx]) * (focal[0] * inv_z)
        row_y = ti.Vector([0.0, 1.0, jy]) * (focal[1] * inv_z)
        # u, v: rows of J exp(omega) W R S, since row . (a + omega x a) = (row + row x omega) . a
        R = rotation_from_quaternion(self.gaussians.quaternion[i])
        scale = ti.exp(self.gaussians.log_scale[i])
        u = rotate_back(R, rotate_back(W, row_x + cross(row_x, omega))) * scale
        v = rotate_back(R, rotate_back(W, row_y + cross(row_y, omega))) * scale

        sharp_xx, sharp_xy, sharp_yy = dot(u, u), dot(u, v), dot(v, v)
        minors = cross(u, v)
        # Cauchy-Binet avoids the cancellation of xx * yy - xy^2, which would leave only rounding for needles.
        sharp_determinant = dot(minors, minors)
        determinant = sharp_determinant + BLUR * (sharp_xx + sharp_yy) + BLUR * BLUR
        compensation = ti.sqrt(ti.max(sharp_determinant / determinant, MIN_DETERMINANT_RATIO))

        self.projected.mean[s] = ti.Vector([focal[0] * tx, focal[1] * ty]) + self.view.centre[None]
        self.projected.conic[s] = ti.Vector([sharp_yy + BLUR, -sharp_xy, sharp_xx + BLUR]) / determinant
        self.projected.depth[s] = p[2]
        self.projected.opacity[s] = compensation / (1.0 + ti.exp(-self.gaussians.opacity_logit[i]))

    @ti.func
    def _shade_one(self, i, s, t):
        """Compute the colour of Gaussian i in slot s, with the camera tangent t."""
        if ti.static(self.gaussians.sh_degree == 0):
            self.projected.colour[s] = ti.max(0.5 + SH_C0 * self.gaussians.sh[i, 0], 0.0)
        else:
            colour = evaluate_sh(ti.static(self.gaussians.sh_degree), self.gaussians.sh, i, self._direction(i, t))
            self.projected.colour[s] = ti.max(0.5 + colour, 0.0)

    @ti.func
    def _direction(self, i, t):
        """Unit vector (3) from the camera to Gaussian i in the world frame, with the camera tangent t."""
        xi = self.tangent[t]
        # Rotating a camera does not move its centre, so only rho changes the direction: W'(p + rho).
        tracked = rotate(self.view.rotation[None], self.gaussians.position[i]) + self.view.translation[None]
        ray = rotate_back(self.view.rotation[None], tracked + ti.Vector([xi[0], xi[1], xi[2]]))
        return ray / ti.sqrt(dot(ray, ray))


@ti.func
def ellipse_span(b, c, per_c, det, limit, reach, top_at, low, high):
    """Lowest and highest v on the ellipse a u^2 + 2 b u v + c v^2 <= limit with u in [low, high].

    The remaining arguments are the same for all tiles of a Gaussian: per_c = 1 / c, det = a c - b^2, reach is the
    largest u, and top_at is the u at which v is largest (v is smallest at -top_at). If the range is empty, the result
    has lowest > highest.
    """
    low = ti.max(low, -reach)
    high = ti.min(high, reach)
    # If the extremum lies outside the range, use the nearer end of the range.
    u_top = ti.min(ti.max(top_at, low), high)
    u_bottom = ti.min(ti.max(-top_at, low), high)
    top = (-b * u_top + ti.sqrt(ti.max(limit * c - det * u_top * u_top, 0.0))) * per_c
    bottom = (-b * u_bottom - ti.sqrt(ti.max(limit * c - det * u_bottom * u_bottom, 0.0))) * per_c
    return ti.select(low > high, ti.Vector([1.0, -1.0]), ti.Vector([bottom - SLACK, top + SLACK]))


@ti.func
def first_centre(x):
    """Index of the first pixel whose centre is at x or after it."""
    return ti.cast(ti.ceil(x - 0.5), ti.i32)


@ti.func
def last_centre(x):
    """Index of the last pixel whose centre is at x or before it."""
    return ti.cast(ti.floor(x - 0.5), ti.i32)


@ti.data_oriented
class EllipseFormulas:
    """Tiles and pixel rows that the ellipses of `projected` reach, in tiles of `tile_width` x `tile_height` pixels."""

    tile_width: int
    tile_height: int

    def __init__(self, view: ViewField, projected: ProjectedGaussians) -> None:
        self.view = view
        self.projected = projected

    @ti.func
    def _ellipse(self, s):
        """Ellipse of slot s: a, b, c of its conic, their determinant, squared reach, reach in x and y, 1 / a, 1 / c."""
        conic = self.projected.conic[s]
        # In float64, since the determinant of a needle would lose all precision in float32.
        a, b, c = ti.cast(conic[0], ti.f64), ti.cast(conic[1], ti.f64), ti.cast(conic[2], ti.f64)
        det = ti.cast(a * c - b * b, self.projected.real)
        opacity = self.projected.opacity[s]
        limit = 2.0 * ti.log(ti.max(opacity, ALPHA_MIN) / ALPHA_MIN)
        reach_x, reach_y = ti.sqrt(limit * conic[2] / det), ti.sqrt(limit * conic[0] / det)
        return ti.Vector([conic[0], conic[1], conic[2], det, limit, reach_x, reach_y, 1.0 / conic[0], 1.0 / conic[2]])

    @ti.func
    def _tile_rows(self, s, e, tiles_y):
        """First tile row that slot s reaches, and the row after the last."""
        reach = e[6] + SLACK
        y = self.projected.mean[s][1]
        first = ti.max(first_centre(y - reach), 0) // self.tile_height
        last = ti.min(last_centre(y + reach), tiles_y * self.tile_height - 1)
        return ti.Vector([first, ti.select(last < 0, 0, last // self.tile_height + 1)])

    @ti.func
    def _tile_columns(self, s, e, tile_y, tiles_x):
        """First tile column that slot s reaches in a tile row, and the column after the last."""
        mean = self.projected.mean[s]
        top = tile_y * self.tile_height + 0.5 - mean[1]
        bottom = top + (self.tile_height - 1)
        span = ellipse_span(e[1], e[0], e[7], e[3], e[4], e[6], -e[1] * e[8] * e[5], top, bottom)
        first = ti.max(first_centre(mean[0] + span[0]), 0)
        last = ti.min(last_centre(mean[0] + span[1]), tiles_x * self.tile_width - 1)
        return ti.select(
            (last < first) | (span[0] > span[1]),
            ti.Vector([0, 0]),
            ti.Vector([first // self.tile_width, last // self.tile_width + 1]),
        )

    @ti.func
    def _pixel_rows(self, s, e, tile_x, tile_y):
        """Rows of a tile that slot s reaches, packed as first | (last + 1) << 16."""
        mean = self.projected.mean[s]
        left = tile_x * self.tile_width + 0.5 - mean[0]
        right = left + (self.tile_width - 1)
        span = ellipse_span(e[1], e[2], e[8], e[3], e[4], e[5], -e[1] * e[7] * e[6], left, right)
        first = ti.max(first_centre(mean[1] + span[0]) - tile_y * self.tile_height, 0)
        last = ti.min(last_centre(mean[1] + span[1]) - tile_y * self.tile_height, self.tile_height - 1)
        return ti.select((last < first) | (span[0] > span[1]), 0, first | ((last + 1) << 16))


@ti.data_oriented
class PhotometricBuffers(ABC):
    """Keeps the render before exposure and vignette, and the vignette at the size of the image.

    Without exposure and vignette, it does nothing and allocates no memory.
    """

    def __init__(self, images: ImageBuffers) -> None:
        self.images = images
        self.real = images.real
        self._active = False
        self._made = False
        self._exposure: np.ndarray | torch.Tensor = np.array(IDENTITY)
        self._loaded: tuple[int, int, int] | None = None  # the vignette in the buffer: its id and size
        self._resized: dict[tuple[int, int, int], tuple[np.ndarray, np.ndarray]] = {}

    def forward(self, exposure: np.ndarray | torch.Tensor | None, vignette: np.ndarray | None) -> None:
        self._active = exposure is not None or vignette is not None
        if not self._active:
            return
        self._make_buffers()
        self._load(vignette)
        if not isinstance(exposure, torch.Tensor):
            exposure = np.ascontiguousarray(IDENTITY if exposure is None else exposure, dtype=np.float64)
        self._exposure = exposure
        self._develop()

    def backward(self) -> None:
        if self._active:
            self._undevelop()

    @abstractmethod
    def _develop(self) -> None:
        """Apply `_exposure` and the vignette to `images.colour`."""

    @abstractmethod
    def _undevelop(self) -> None:
        """Propagate `images.colour_grad` back, and restore the render in `images.colour`."""

    def _make_buffers(self) -> None:
        if self._made:
            return
        self._made = True
        self.rendered, self.vignette = ti.field(self.real), ti.field(self.real)
        builder = ti.FieldsBuilder()
        builder.dense(ti.i, 3 * self.images.plane).place(self.rendered, self.vignette)
        builder.finalize()
        refuse_too_many_fields(self.vignette)

    def _load(self, vignette: np.ndarray | None) -> None:
        """Write the vignette to the buffer at the size of the image, unless it is there already."""
        width, height = self.images.width, self.images.height
        key = (id(vignette), width, height)
        if key == self._loaded:
            return
        self._loaded = key
        if vignette is None:
            self.vignette.fill(1.0)
            return
        if key not in self._resized:
            image = np.ascontiguousarray(vignette, dtype=np.float32)
            if image.shape[:2] != (height, width):
                image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
            # Keep the original alive as long as its id is a key.
            self._resized[key] = vignette, image
        self._set_vignette(width, height, self._resized[key][1])

    @ti.kernel
    def _set_vignette(self, width: ti.i32, height: ti.i32, image: ti.types.ndarray(dtype=ti.f32, ndim=3)):
        for y in range(height):
            row = (y + PAD) * self.images.stride + PAD
            for x in range(width):
                for c in ti.static(range(3)):
                    self.vignette[c * self.images.plane + row + x] = image[y, x, c]


RADIUS = 5
C1 = 0.01**2
C2 = 0.03**2


def window_weights() -> tuple[float, ...]:
    """The 11 weights of the Gaussian window with sigma 1.5; they sum to 1."""
    w = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / 1.5) ** 2)
    return tuple(float(v) for v in w / w.sum())


class LossValues:
    """Means over the valid pixels and channels of one view. On a GPU, the first access waits for the device.

    Args:
        sums: Returns the sums (4,) of absolute error, SSIM, squared error and the number of values. It is called on the
            first access.
    """

    def __init__(self, sums: Callable[[], NDArray[np.float64]]) -> None:
        self._sums = sums

    @cached_property
    def _means(self) -> tuple[float, float, float]:
        l1, ssim, square, count = (float(v) for v in self._sums())
        count = max(count, 1.0)
        return l1 / count, ssim / count, square / count

    @property
    def l1(self) -> float:
        """Mean absolute error."""
        return self._means[0]

    @property
    def ssim(self) -> float:
        """Mean SSIM."""
        return self._means[1]

    @property
    def squared_error(self) -> float:
        """Mean squared error."""
        return self._means[2]

    @property
    def psnr(self) -> float:
        """Peak signal-to-noise ratio [dB]."""
        return float(-10.0 * np.log10(max(self.squared_error, 1e-12)))
