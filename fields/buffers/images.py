"""`ImageBuffers`: the rendered image, the reference image, and gradients."""
# pyright: reportInvalidTypeForm=false

import weakref
from collections import OrderedDict

import numpy as np
import torch

from fields.buffers.tiles import TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH
from fields.runtime.backend import on_gpu, torch_device
from fields.runtime.compiled_kernel import HANDED_OUT, CompiledLoop
from fields.runtime.engine import ti


class DeviceImages:
    """Cache of device copies of keyframe images, which stay in host memory.

    An image is identified by its array object, whose contents must not change. When the array is garbage collected, its
    copy is dropped.

    Args:
        max_bytes: Capacity [bytes].

    Attributes:
        bytes: Bytes of all copies.
    """

    def __init__(self, max_bytes: float) -> None:
        self.max_bytes = max_bytes
        self.bytes = 0
        self._device = torch_device()
        self._copies: OrderedDict[int, tuple[weakref.ref, torch.Tensor]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._copies)

    def __contains__(self, image: np.ndarray) -> bool:
        return id(image) in self._copies

    def of(self, image: np.ndarray) -> torch.Tensor:
        """Return the device copy of a uint8 image, uploading it if necessary. Does not wait for the device."""
        key = id(image)
        if key in self._copies:
            self._copies.move_to_end(key)
            return self._copies[key][1]
        copy = self._upload(np.ascontiguousarray(image))
        self._copies[key] = weakref.ref(image, lambda _: self._drop(key)), copy
        self.bytes += copy.nbytes
        while self.bytes > self.max_bytes and len(self._copies) > 1:
            self._drop(next(iter(self._copies)))
        return copy

    def _upload(self, image: np.ndarray) -> torch.Tensor:
        host = torch.from_numpy(image)
        if self._device.type == "cpu":
            return host.clone()
        # A copy from memory that is not pinned would wait for the kernels launched before.
        pinned = torch.empty(host.shape, dtype=host.dtype, pin_memory=True)
        pinned.copy_(host)
        return pinned.to(self._device, non_blocking=True)

    def _drop(self, key: int) -> None:
        if key in self._copies:
            self.bytes -= self._copies.pop(key)[1].nbytes


# Border of zeros around every plane [px]. An 11x11 window reads 5 px beyond the image without a branch.
PAD = 8
# The loss works on strips of rows in parallel, with separate scratch rows for each channel of a strip.
STRIPS = 32
SCRATCH_ROWS = 8
# Eight rows per chunk, see `fields.runtime.compiled_kernel`.
SPREAD = HANDED_OUT // 8


@ti.data_oriented
class ImageBuffers:
    """Image buffers for any size up to a maximum, without recompilation.

    Planar buffers hold one plane per channel, row-major with a border of `PAD` zeros: pixel (x, y) of channel c is at
    `c * plane + (y + PAD) * stride + x + PAD`. Tile buffers hold the 256 pixels of a tile consecutively, so that a loop
    over them is one vector loop. Capacities are rounded up, mostly to powers of two, so that most image sizes share the
    kernels of the offline cache. The values have the Taichi type `real`, `ti.f32` or `ti.f64`.

    Args:
        builder: Builder that the buffers are placed in.
        max_width: Largest image width [px].
        max_height: Largest image height [px].
        cache_gb: Device memory for copies of reference images, on a GPU [GiB].

    Attributes:
        masked: Whether the reference has masked pixels. Always False on a GPU, where the loss handles the mask itself.
    """

    def __init__(
        self, builder: ti.FieldsBuilder, max_width: int, max_height: int, real=ti.f32, cache_gb: float = 2.0
    ) -> None:
        self.real = real
        self.dtype = np.float64 if real == ti.f64 else np.float32
        self.max_width, self.max_height = max_width, max_height
        tiles = -(-max_width // TILE_WIDTH) * -(-max_height // TILE_HEIGHT)
        self.max_tiles = 1 << (tiles - 1).bit_length()
        # Compile-time constants, so that LLVM sees that rows do not overlap. The border added to a power of two keeps
        # the rows of a window out of the same cache set.
        self.stride = (1 << (max_width - 1).bit_length()) + 2 * PAD
        self.plane = self.stride * (-(-max_height // 256) * 256 + 2 * PAD)
        self.width = self.height = 0
        self.masked = False
        self._references = DeviceImages(cache_gb * 2**30) if on_gpu() else None
        self._take_reference = CompiledLoop(
            self._set_reference_rows if self._references is None else self._set_reference_pixels, 6
        )

        def scalar():
            return ti.field(real)

        # Tile buffers: accumulators of compositing, and the per-pixel state of its backward pass.
        self.transmittance, self.red, self.green, self.blue, self.z = (scalar() for _ in range(5))
        self.behind, self.red_grad, self.green_grad, self.blue_grad, self.z_grad = (scalar() for _ in range(5))
        # Planar buffers.
        self.colour, self.depth, self.opacity = scalar(), scalar(), scalar()
        self.colour_grad, self.depth_grad, self.opacity_grad = scalar(), scalar(), scalar()
        self.reference, self.valid = scalar(), scalar()
        # SSIM: derivatives with respect to the render's local mean, square and product (3 planes per channel); the map.
        self.ssim_partial, self.ssim = scalar(), scalar()
        self.rows = scalar()
        self.background = ti.Vector.field(3, real)

        tile_pixels = self.max_tiles * TILE_PIXELS
        for buffer in (self.transmittance, self.red, self.green, self.blue, self.z, self.behind):
            builder.dense(ti.i, tile_pixels).place(buffer)
        for buffer in (self.red_grad, self.green_grad, self.blue_grad, self.z_grad):
            builder.dense(ti.i, tile_pixels).place(buffer)
        for buffer in (self.depth, self.opacity, self.depth_grad, self.opacity_grad, self.valid):
            builder.dense(ti.i, self.plane).place(buffer)
        for buffer in (self.colour, self.colour_grad, self.reference, self.ssim):
            builder.dense(ti.i, 3 * self.plane).place(buffer)
        builder.dense(ti.i, 9 * self.plane).place(self.ssim_partial)
        builder.dense(ti.i, 3 * STRIPS * SCRATCH_ROWS * self.stride).place(self.rows)
        builder.place(self.background)

    def resize(self, width: int, height: int) -> None:
        """Set the image size [px], and clear the planar buffers if it changes.

        Raises ValueError if the size exceeds the capacity.
        """
        if (width, height) == (self.width, self.height):
            return
        if width > self.max_width or height > self.max_height:
            raise ValueError(
                f"image of {width}x{height} exceeds the buffers made for {self.max_width}x{self.max_height}"
            )
        self.width, self.height = width, height
        self._clear()

    # Loops over a plane, since many GPUs start at most 65,535 groups of 128 threads by Vulkan.

    @ti.kernel
    def _clear(self):
        for i in range(self.plane):
            self.depth[i] = 0.0
            self.opacity[i] = 0.0
            self.depth_grad[i] = 0.0
            self.opacity_grad[i] = 0.0
            self.valid[i] = 0.0
            for c in ti.static(range(3)):
                self.colour[c * self.plane + i] = 0.0
                self.colour_grad[c * self.plane + i] = 0.0
                self.reference[c * self.plane + i] = 0.0
                self.ssim[c * self.plane + i] = 0.0
            for c in ti.static(range(9)):
                self.ssim_partial[c * self.plane + i] = 0.0

    @ti.kernel
    def clip_colour(self):
        """Clip the rendered image to [0, 1]."""
        for i in range(self.plane):
            for c in ti.static(range(3)):
                at = c * self.plane + i
                self.colour[at] = ti.min(ti.max(self.colour[at], 0.0), 1.0)

    # ---- to and from NumPy -----------------------------------------------------------------------------------

    def set_reference(self, image: np.ndarray) -> None:
        """Set the reference image: RGB and validity (H, W, 4) uint8, 255 at valid pixels and 0 at masked ones."""
        self.masked = self._references is None and not image[..., 3].all()
        pixels = np.ascontiguousarray(image) if self._references is None else self.on_device(image)
        self._take_reference(self.width * self.height, self.width, self.height, pixels)

    def on_device(self, image: np.ndarray) -> torch.Tensor:
        """Return a GPU's copy of a reference image, for kernels that call `take_pixel`."""
        assert self._references is not None
        return self._references.of(image)

    def set_gradients(self, *gradients: np.ndarray | torch.Tensor) -> None:
        """Set d loss / d image.

        Args:
            *gradients: Gradients of colour (H, W, 3), depth (H, W) and opacity (H, W). Tensors must be contiguous, of
                the buffers' type, and on the device that kernels run on.
        """
        arrays = [a if isinstance(a, torch.Tensor) else np.ascontiguousarray(a, dtype=self.dtype) for a in gradients]
        self._set_gradients(self.width, self.height, *arrays)

    def read_into(self, colour: torch.Tensor, depth: torch.Tensor, opacity: torch.Tensor) -> None:
        """Write the rendered image into tensors.

        The tensors must be contiguous, of the buffers' type, and on the device that kernels run on.

        Args:
            colour: Output (H, W, 3).
            depth: Output (H, W).
            opacity: Output (H, W).
        """
        self._read_picture(self.width, self.height, colour, depth, opacity)

    def colour_to_numpy(self) -> np.ndarray:
        """Return the rendered image (H, W, 3), not clipped."""
        out = np.empty((self.height, self.width, 3), dtype=self.dtype)
        self._read_planes(self.width, self.height, self.colour, out)
        return out

    def depth_to_numpy(self) -> np.ndarray:
        """Return the composited depth (H, W): the sum of weight times z, not divided by opacity."""
        out = np.empty((self.height, self.width, 1), dtype=self.dtype)
        self._read_planes(self.width, self.height, self.depth, out)
        return out[..., 0]

    def opacity_to_numpy(self) -> np.ndarray:
        """Return the composited opacity (H, W): 1 minus the transmittance behind the last Gaussian."""
        out = np.empty((self.height, self.width, 1), dtype=self.dtype)
        self._read_planes(self.width, self.height, self.opacity, out)
        return out[..., 0]

    def colour_gradient_to_numpy(self) -> np.ndarray:
        """Return d loss / d colour (H, W, 3)."""
        out = np.empty((self.height, self.width, 3), dtype=self.dtype)
        self._read_planes(self.width, self.height, self.colour_grad, out)
        return out

    def ssim_to_numpy(self) -> np.ndarray:
        """Return the last SSIM map (H, W, 3)."""
        out = np.empty((self.height, self.width, 3), dtype=self.dtype)
        self._read_planes(self.width, self.height, self.ssim, out)
        return out

    @ti.kernel
    def _set_reference_rows(
        self, alone: ti.template(), width: ti.i32, height: ti.i32, image: ti.types.ndarray(dtype=ti.u8, ndim=3)
    ):
        ti.loop_config(serialize=alone)
        for i in range(height * SPREAD):
            if i % SPREAD == 0:
                y = i // SPREAD
                row = (y + PAD) * self.stride + PAD
                # A first access outside the loop makes Taichi fetch the tree's root once, and not at every pixel.
                self.valid[row] = 0.0
                for c in ti.static(range(3)):
                    for x in range(width):
                        self.reference[c * self.plane + row + x] = ti.cast(image[y, x, c], self.real) / 255.0
                for x in range(width):
                    self.valid[row + x] = ti.cast(image[y, x, 3], self.real) / 255.0

    @ti.kernel
    def _set_reference_pixels(
        self, alone: ti.template(), width: ti.i32, height: ti.i32, image: ti.types.ndarray(dtype=ti.u8, ndim=3)
    ):
        """The same with one thread per pixel, for a GPU."""
        ti.loop_config(serialize=alone)
        for i in range(width * height):
            self.take_pixel(i % width, i // width, image)

    @ti.func
    def take_pixel(self, x, y, image: ti.template()):
        """Take a pixel of the reference image."""
        at = (y + PAD) * self.stride + PAD + x
        for c in ti.static(range(3)):
            self.reference[c * self.plane + at] = ti.cast(image[y, x, c], self.real) / 255.0
        self.valid[at] = ti.cast(image[y, x, 3], self.real) / 255.0

    @ti.kernel
    def _set_gradients(
        self,
        width: ti.i32,
        height: ti.i32,
        colour: ti.types.ndarray(),
        depth: ti.types.ndarray(),
        opacity: ti.types.ndarray(),
    ):
        for i in range(width * height):
            x, y = i % width, i // width
            at = (y + PAD) * self.stride + PAD + x
            for c in ti.static(range(3)):
                self.colour_grad[c * self.plane + at] = colour[y, x, c]
            self.depth_grad[at] = depth[y, x]
            self.opacity_grad[at] = opacity[y, x]

    @ti.kernel
    def _read_picture(
        self,
        width: ti.i32,
        height: ti.i32,
        colour: ti.types.ndarray(),
        depth: ti.types.ndarray(),
        opacity: ti.types.ndarray(),
    ):
        for i in range(width * height):
            x, y = i % width, i // width
            at = (y + PAD) * self.stride + PAD + x
            for c in ti.static(range(3)):
                colour[y, x, c] = self.colour[c * self.plane + at]
            depth[y, x] = self.depth[at]
            opacity[y, x] = self.opacity[at]

    @ti.kernel
    def _read_planes(self, width: ti.i32, height: ti.i32, buffer: ti.template(), out: ti.types.ndarray()):
        channels = out.shape[2]
        for i in range(width * height):
            x, y = i % width, i // width
            for c in range(channels):
                out[y, x, c] = buffer[c * self.plane + (y + PAD) * self.stride + PAD + x]
