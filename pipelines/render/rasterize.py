"""`rasterize`: the renderer as a differentiable PyTorch function."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import hat, orthonormalised
from fields.map.gaussians import SH_C0, GaussianField
from fields.runtime.backend import on_gpu, program, torch_device
from fields.runtime.engine import engine, lock, ti
from fields.runtime.tenancy import empty, settled
from pipelines.render.renderer import Renderer

REAL = {torch.float32: ti.f32, torch.float64: ti.f64}
# Size of the pool on a GPU, where it is allocated at once. On the CPU, memory follows the Gaussians in use.
GPU_POOL = 1_500_000
# Number of sets of fields that are kept, for other types, SH degrees and image sizes.
MAX_KEPT = engine().max_rasterizers
# Largest deviation of a pose's entries from a rigid motion. This tolerates rounding and drift, but no scale or shear.
MAX_DRIFT = 1e-3
# Logarithm of the largest standard deviation in the image [px]: numbers of wider Gaussians leave the range of float32.
MAX_SPAN = math.log(1e8)


class RasterizedView(NamedTuple):
    """Result of `rasterize`.

    Attributes:
        image: Colour (H, W, 3), not clipped.
        depth: Depth (H, W) as the weighted sum of z, not divided by opacity.
        opacity: Opacity (H, W).

    Example:
        view: modp_ti.RasterizedView = modp_ti.rasterize(**tensors, T_camera_world=torch.eye(4), camera=camera)
        image, depth, opacity = view
    """

    image: Tensor
    depth: Tensor
    opacity: Tensor


def rasterize(
    position: Tensor,
    log_scale: Tensor,
    quaternion: Tensor,
    opacity_logit: Tensor,
    sh: Tensor | None = None,
    *,
    T_camera_world: Tensor,
    camera: PinholeCamera,
    colour: Tensor | None = None,
    background: Tensor | None = None,
    near: float | Tensor = 0.01,
) -> RasterizedView:
    """Render N Gaussians, differentiably with respect to every tensor. Call `initialise` first.

    All tensors except `T_camera_world` must have the same type, float32 or float64 (CPU only), and be on the device
    that `initialise` chose. The values are those of 3DGS files, as `read_splats` returns them.

    The pose is replaced by the rigid motion nearest to it. Its gradient is therefore tangent to SE(3): it is correct
    for any parametrisation of the pose, such as `torch_exp_se3(xi) @ T`, and has no component along which T would stop
    being rigid. A plain gradient step on T itself leaves SE(3) to second order.

    The function keeps its fields between calls, one set for each type, number of harmonics, and doubling of the largest
    image size. There is room for two sets with Taichi; another takes their place if no map is in use, which takes
    seconds, so start with the largest image. `backward` renders again if another image has been rendered in between. It
    is not differentiable itself. Calls from several threads wait for one another. On CUDA, everything runs on the
    default stream.

    Args:
        position: Means (N, 3) in the world frame.
        log_scale: Logarithms of the standard deviations (N, 3).
        quaternion: Rotations (N, 4) as (w, x, y, z), of any length but zero.
        opacity_logit: Logits (N,) of the opacities.
        sh: Coefficients (N, K, 3) of the spherical harmonics, with K of 1, 4, 9 or 16.
        T_camera_world: Pose (4, 4), world to camera, OpenCV axes; float32 or float64, on any device.
        camera: Intrinsics and image size.
        colour: View-independent colours (N, 3), instead of `sh`. Values below 0 are drawn as 0.
        background: Colour (3,) where no Gaussian is drawn; None for black.
        near: Depth below which nothing is drawn [scene units], above 0.

    Returns:
        Image, depth and opacity.

    Raises:
        TypeError: If types do not fit, or not exactly one of `sh` and `colour` is given. The message is one line.
        ValueError: If shapes, devices or values do not fit. The message is one line.
        RuntimeError: If `initialise` has not been called, or there is no room for another set of fields.

    Example:
        state = modp_ti.read_splats("out/room/splats.ply")
        tensors = {name: torch.from_numpy(values).requires_grad_() for name, values in state.items()}
        modp_ti.rasterize(**tensors, T_camera_world=torch.eye(4), camera=camera).image.mean().backward()
    """
    program()
    geometry = {"position": position, "log_scale": log_scale, "quaternion": quaternion, "opacity_logit": opacity_logit}
    _check(geometry, sh, colour, T_camera_world, background)
    near = float(near)
    if not 0.0 < near < math.inf:
        raise ValueError(f"near is {near}, expected a positive depth")
    _refuse_boundless(position.detach(), log_scale.detach(), T_camera_world.detach(), camera, near)
    coefficients = sh if colour is None else ((colour - 0.5) / SH_C0)[:, None]
    image, depth, opacity = _Rasterize.apply(*geometry.values(), coefficients, T_camera_world, camera, near)
    if background is not None:
        image = image + (1.0 - opacity)[..., None] * background
    return RasterizedView(image, depth, opacity)


def _check(
    geometry: dict[str, Tensor],
    sh: Tensor | None,
    colour: Tensor | None,
    T_camera_world: Tensor,
    background: Tensor | None,
) -> None:
    """Raise TypeError or ValueError for the first tensor that does not fit the others or the device."""
    if (sh is None) == (colour is None):
        raise TypeError("rasterize takes either sh or colour")
    tensors = geometry | {name: tensor for name, tensor in (("sh", sh), ("colour", colour)) if tensor is not None}
    given = tensors | {"T_camera_world": T_camera_world}
    given |= {} if background is None else {"background": background}
    for name, tensor in given.items():
        if not isinstance(tensor, Tensor):
            raise TypeError(f"{name} is a {type(tensor).__name__}, expected a torch.Tensor")
        if tensor.dtype not in REAL:
            raise TypeError(f"{name} is {_kind(tensor)}, expected float32 or float64")
    kind, device = tensors["position"].dtype, torch_device()
    if kind == torch.float64 and on_gpu():
        raise TypeError("position is float64, which the GPU's kernels do not have: use float32, or the CPU")
    for name, tensor in given.items():
        if name == "T_camera_world":
            continue
        if tensor.dtype != kind:
            raise TypeError(f"{name} is {_kind(tensor)}, position {_kind(tensors['position'])}: give all in one type")
        if tensor.device.type != device.type:
            raise ValueError(
                f"{name} lies on {tensor.device}, the kernels run on {device}: move it there, or initialise another"
            )
    n = tensors["position"].shape[0] if tensors["position"].ndim else 0
    shapes = {"position": (n, 3), "log_scale": (n, 3), "quaternion": (n, 4), "opacity_logit": (n,), "colour": (n, 3)}
    shapes |= {"T_camera_world": (4, 4), "background": (3,)}
    for name, tensor in given.items():
        shape = tuple(tensor.shape)
        if name == "sh":
            if shape not in [(n, k, 3) for k in (1, 4, 9, 16)]:
                raise ValueError(f"sh has shape {shape}, expected ({n}, K, 3) with K of 1, 4, 9 or 16")
        elif shape != shapes[name]:
            raise ValueError(f"{name} has shape {shape}, expected {shapes[name]}")
        finite = torch.isfinite(tensor.detach())
        if not finite.all():
            at = "" if name not in tensors else f" of Gaussian {int((~finite).nonzero()[0, 0])}"
            raise ValueError(f"{name}{at} is not finite")
    zero = (tensors["quaternion"].detach() == 0).all(dim=1)
    if zero.any():
        raise ValueError(f"quaternion of Gaussian {int(zero.nonzero()[0, 0])} is zero")


def _refuse_boundless(position: Tensor, log_scale: Tensor, T: Tensor, camera: PinholeCamera, near: float) -> None:
    """Raise ValueError for a Gaussian whose standard deviation in the image exceeds `MAX_SPAN`."""
    if len(log_scale) == 0:
        return
    widest, focal = log_scale.amax(dim=1), math.log(max(camera.fx, camera.fy))
    if float(widest.max()) + focal - math.log(near) <= MAX_SPAN:  # nearly always
        return
    depth = position @ T[2, :3].to(position) + float(T[2, 3])
    bad = (depth > near) & (widest + focal - depth.clamp(min=near).log() > MAX_SPAN)
    if bad.any():
        at = int(bad.nonzero()[0, 0])
        raise ValueError(
            f"log_scale of Gaussian {at} is {float(widest[at]):.3g}, which is more than 1e8 px wide in this view"
        )


def _kind(tensor: Tensor) -> str:
    return str(tensor.dtype).removeprefix("torch.")


def _rigid(T_camera_world: Tensor) -> NDArray[np.float64]:
    """Rigid motion (4, 4) nearest to a pose. Raises ValueError if it deviates by more than `MAX_DRIFT`."""
    T = T_camera_world.detach().cpu().numpy().astype(np.float64)
    rigid = orthonormalised(T)
    rigid[3] = 0.0, 0.0, 0.0, 1.0
    if np.abs(T - rigid).max() > MAX_DRIFT:
        raise ValueError(
            f"T_camera_world is no rigid motion: an entry is {np.abs(T - rigid).max():.2g} off; "
            "optimise a tangent, T = torch_exp_se3(xi) @ T"
        )
    return rigid


class _Rasterizer:
    """The fields for one type, SH degree and maximum image size.

    Attributes:
        tenancy: Whether the fields are still there.
        drawn: Number of images rendered so far. Only the last one is stored.
    """

    def __init__(self, degree: int, kind: torch.dtype, width: int, height: int) -> None:
        with settled(nodes=4, kept=False) as self.tenancy:
            self.gaussians = GaussianField(degree, GPU_POOL if on_gpu() else engine().max_gaussians, REAL[kind])
            self.renderer = Renderer(self.gaussians, width, height)
        self.kind, self.width, self.height = kind, width, height
        self.drawn = 0

    def fits(self, degree: int, kind: torch.dtype, camera: PinholeCamera) -> bool:
        fits = camera.width <= self.width and camera.height <= self.height
        return fits and (degree, kind) == (self.gaussians.sh_degree, self.kind)

    def draw(self, tensors: list[Tensor], T: NDArray[np.float64], camera: PinholeCamera, near: float) -> None:
        self.gaussians.take(tensors)
        self.renderer.forward(camera, T, near)
        self.drawn += 1


_rasterizers: list[_Rasterizer] = []


def _rasterizer(kind: torch.dtype, sh_count: int, camera: PinholeCamera) -> _Rasterizer:
    """Return an existing rasterizer that fits, or a new one with the size rounded up as `ImageBuffers` does."""
    if not all(rasterizer.tenancy.is_open for rasterizer in _rasterizers):
        _rasterizers.clear()
    degree = int(np.sqrt(sh_count)) - 1
    for found in _rasterizers:
        if found.fits(degree, kind, camera):
            return found
    if len(_rasterizers) == MAX_KEPT:
        empty()
        _rasterizers.clear()
    width, height = max(64, 1 << (camera.width - 1).bit_length()), -(-camera.height // 256) * 256
    _rasterizers.append(_Rasterizer(degree, kind, width, height))
    return _rasterizers[-1]


class _Rasterize(torch.autograd.Function):
    """position, log_scale, quaternion, opacity_logit, sh, T_camera_world -> image, depth, opacity."""

    @staticmethod
    def forward(ctx, *arguments) -> tuple[Tensor, Tensor, Tensor]:
        *inputs, camera, near = arguments
        ctx.camera, ctx.near, ctx.pose = camera, near, _rigid(inputs[5])
        ctx.save_for_backward(*inputs)
        ctx.set_materialize_grads(False)
        size = camera.height, camera.width
        like = {"dtype": inputs[0].dtype, "device": inputs[0].device}
        outputs = torch.empty(*size, 3, **like), torch.empty(size, **like), torch.empty(size, **like)
        with lock:
            ctx.rasterizer = rasterizer = _draw(ctx, inputs)
            ctx.drawn = rasterizer.drawn
            rasterizer.renderer.images.read_into(*outputs)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  # `once_differentiable` hides the name of ctx
        ctx, *gradients: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        inputs = ctx.saved_tensors
        with_depth = gradients[1] is not None
        size, like = (ctx.camera.height, ctx.camera.width), inputs[0]
        shapes = (*size, 3), size, size
        filled = [
            like.new_zeros(shape) if gradient is None else gradient.to(like.dtype).contiguous()
            for shape, gradient in zip(shapes, gradients, strict=True)
        ]
        outputs = [torch.zeros_like(tensor, memory_format=torch.contiguous_format) for tensor in inputs[:5]]
        with lock:
            rasterizer = ctx.rasterizer
            # Another image may have been rendered since, or Taichi restarted.
            if not rasterizer.tenancy.is_open or rasterizer.drawn != ctx.drawn:
                rasterizer = _draw(ctx, inputs)
            renderer, gaussians = rasterizer.renderer, rasterizer.gaussians
            gaussians.clear_gradients()
            renderer.images.set_gradients(*filled)
            renderer.backward(with_depth)
            gaussians.gradients_into(outputs)
            return *outputs, _pose_gradient(renderer.camera_gradient(), ctx.pose, inputs[5]), None, None


def _draw(ctx, inputs: list[Tensor]) -> _Rasterizer:
    rasterizer = _rasterizer(inputs[0].dtype, inputs[4].shape[1], ctx.camera)
    rasterizer.draw([tensor.detach().contiguous() for tensor in inputs[:5]], ctx.pose, ctx.camera, ctx.near)
    return rasterizer


def _pose_gradient(tangent: NDArray[np.float64], T: NDArray[np.float64], like: Tensor) -> Tensor:
    """d loss / d T (4, 4) from the gradient (6,) with respect to the tangent on the left of T.

    T is replaced by its nearest rigid motion, whose derivative projects dR onto the tangents [omega]x R. G is the
    unique tangent with <G, d(exp(xi) T)> = tangent . xi for every xi.
    """
    G = np.zeros((4, 4))
    G[:3, 3] = tangent[:3]
    G[:3, :3] = 0.5 * hat(tangent[3:] - np.cross(T[:3, 3], tangent[:3])) @ T[:3, :3]
    return torch.from_numpy(G).to(like)
