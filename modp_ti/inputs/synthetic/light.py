"""Light that changes from frame to frame, and a lens that darkens the corners: what `mapping.exposure` is there for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modp_ti.inputs.synthetic.walks import smooth_walks

__all__ = ["LightChange"]


@dataclass(frozen=True)
class LightChange:
    """What the camera makes of the room's colours: (A colour + b) * vignette, cut to [0, 1].

    The exposure (A, b) wanders from frame to frame with Gaussian standard deviations. gain: of the logarithm of the
    common factor. white_balance: of the logarithm of each channel's further factor. bias: of what is added to each
    channel. drift: frames over which they are correlated, 0 for independent ones. vignette: share of the light that is
    lost in the corners; it grows with the square of the distance from the middle.
    """

    gain: float = 0.25
    white_balance: float = 0.05
    bias: float = 0.01
    drift: float = 8.0
    vignette: float = 0.0

    @staticmethod
    def none() -> LightChange:
        """A camera that shows the colours as they are."""
        return LightChange(gain=0.0, white_balance=0.0, bias=0.0)

    def scaled(self, factor: float) -> LightChange:
        """The same with an exposure that wanders `factor` times as much."""
        return LightChange(
            factor * self.gain, factor * self.white_balance, factor * self.bias, self.drift, self.vignette
        )

    def exposures(self, frames: int, rng: np.random.Generator) -> NDArray[np.float64]:
        """(A, b) (frames, 3, 4) of every frame, A diagonal."""
        walks = smooth_walks(frames, 7, self.drift, rng)
        channels = np.arange(3)
        exposures = np.zeros((frames, 3, 4))
        exposures[:, channels, channels] = np.exp(self.gain * walks[:, :1] + self.white_balance * walks[:, 1:4])
        exposures[:, :, 3] = self.bias * walks[:, 4:]
        return exposures

    def corner_vignette(self, width: int, height: int) -> NDArray[np.float32] | None:
        """The vignette (height, width, 3); None where no light is lost."""
        if self.vignette == 0.0:
            return None
        x = (2 * np.arange(width) + 1) / width - 1
        y = (2 * np.arange(height) + 1) / height - 1
        share = 1.0 - self.vignette * 0.5 * (x**2 + y[:, None] ** 2)
        vignette = np.repeat(share[..., None], 3, axis=2).astype(np.float32)
        vignette.flags.writeable = False  # one array serves every frame
        return vignette
