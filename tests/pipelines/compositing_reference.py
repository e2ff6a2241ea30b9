"""Reference implementation of compositing: one task per pixel, over the Gaussians of its tile.

It follows the equations of `pipelines/render/cpu/compositing.py` directly. It is much slower on a CPU, since each
pixel's loop is scalar.
"""

from fields.buffers.images import PAD
from fields.buffers.tiles import TILE_HEIGHT, TILE_WIDTH
from fields.runtime.engine import ti
from pipelines.render.cpu.compositing import Compositing
from pipelines.render.formulas import ALPHA_MAX, ALPHA_MIN, OPAQUE


@ti.data_oriented
class ReferenceCompositing(Compositing):
    """Drop-in replacement for `Compositing`, without the gradient of depth."""

    def forward(self) -> None:
        self._forward_pixels(self.view.width, self.view.height)

    def backward(self, with_depth: bool = False) -> None:
        if with_depth:
            raise NotImplementedError("the reference has no gradient of depth")
        self._clear(self.projected.count)
        self._backward_pixels(self.view.width, self.view.height)

    @ti.func
    def _alpha(self, s, x, y):
        """Alpha of slot s at a pixel centre (0 where it is not drawn), and the pixel's offset (2) from its mean."""
        d = ti.Vector([x, y]) - self.projected.mean[s]
        conic = self.projected.conic[s]
        power = -0.5 * (conic[0] * d[0] * d[0] + conic[2] * d[1] * d[1]) - conic[1] * d[0] * d[1]
        alpha = self.projected.opacity[s] * ti.exp(power)
        return ti.select(alpha < ALPHA_MIN, 0.0, alpha), d

    @ti.kernel
    def _forward_pixels(self, width: ti.i32, height: ti.i32):
        for y, x in ti.ndrange(height, width):
            tile = y // TILE_HEIGHT * ((width + TILE_WIDTH - 1) // TILE_WIDTH) + x // TILE_WIDTH
            T = ti.cast(1.0, self.real)
            colour = ti.Vector.zero(self.real, 3)
            depth = ti.cast(0.0, self.real)
            first = self.pairs.first[tile]
            for k in range(first, first + self.pairs.tile_count[tile]):
                if T > OPAQUE:
                    s = self.pairs.slot[k]
                    alpha, _ = self._alpha(s, x + 0.5, y + 0.5)
                    weight = ti.min(alpha, ALPHA_MAX) * T
                    colour += weight * self.projected.colour[s]
                    depth += weight * self.projected.depth[s]
                    T -= weight
            at = (y + PAD) * self.images.stride + PAD + x
            background = self.images.background[None]
            for c in ti.static(range(3)):
                self.images.colour[c * self.images.plane + at] = colour[c] + T * background[c]
            self.images.depth[at] = depth
            self.images.opacity[at] = 1.0 - T

    @ti.kernel
    def _clear(self, slots: ti.i32):
        for s in range(slots):
            self.projected.colour.grad[s].fill(0.0)
            self.projected.depth.grad[s] = 0.0
            self.projected.opacity.grad[s] = 0.0
            self.projected.mean.grad[s].fill(0.0)
            self.projected.conic.grad[s].fill(0.0)

    @ti.kernel
    def _backward_pixels(self, width: ti.i32, height: ti.i32):
        for y, x in ti.ndrange(height, width):
            tile = y // TILE_HEIGHT * ((width + TILE_WIDTH - 1) // TILE_WIDTH) + x // TILE_WIDTH
            at = (y + PAD) * self.images.stride + PAD + x
            gradient = ti.Vector.zero(self.real, 3)
            behind = -self.images.opacity_grad[at] * (1.0 - self.images.opacity[at])
            for c in ti.static(range(3)):
                gradient[c] = self.images.colour_grad[c * self.images.plane + at]
                behind += gradient[c] * self.images.colour[c * self.images.plane + at]
            T = ti.cast(1.0, self.real)
            first = self.pairs.first[tile]
            for k in range(first, first + self.pairs.tile_count[tile]):
                if T > OPAQUE:
                    s = self.pairs.slot[k]
                    alpha, d = self._alpha(s, x + 0.5, y + 0.5)
                    if alpha > 0.0:
                        weight = ti.min(alpha, ALPHA_MAX) * T
                        shade = gradient.dot(self.projected.colour[s])
                        behind -= weight * shade
                        self.projected.colour.grad[s] += weight * gradient
                        if alpha <= ALPHA_MAX:
                            by_power = weight * shade - behind * alpha / (1.0 - alpha)
                            conic = self.projected.conic[s]
                            self.projected.opacity.grad[s] += by_power / self.projected.opacity[s]
                            self.projected.mean.grad[s] += by_power * ti.Vector(
                                [conic[0] * d[0] + conic[1] * d[1], conic[1] * d[0] + conic[2] * d[1]]
                            )
                            self.projected.conic.grad[s] += by_power * ti.Vector(
                                [-0.5 * d[0] * d[0], -d[0] * d[1], -0.5 * d[1] * d[1]]
                            )
                        T -= weight
