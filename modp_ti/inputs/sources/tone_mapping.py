"""Tone mapping of HDR pictures (BT.2100: PQ or HLG, BT.2020 primaries) to 8 bits for ordinary displays, in closed form.

1. The transfer function gives the light on the display, HLG's that of a display of 1000 cd/m² (gamma 1.2).
2. A matrix converts BT.2020's primaries to BT.709's. Colours outside become the nearest on its boundary, per channel.
3. The curve of BT.2390 (EETF) maps 0 to 1000 cd/m² to 0 to 203 cd/m², the white of BT.2408, per channel: light up to
   93 cd/m² stays as it is, brighter light is compressed.
4. The inverse of BT.1886 gives the code: (light / 203)^(1 / 2.4).

The curve is the same for all pictures, whatever their brightest, so that the frames of a video stay comparable.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

PEAK, WHITE = 1000.0, 203.0
"""Brightest light that is kept apart from others, and what it is mapped to [cd/m²]."""

CODES = 1 << 16
# PQ of SMPTE ST 2084; HLG's a, b, c of ARIB STD-B67.
M1, M2, C1, C2, C3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
A, B, C = 0.17883277, 0.28466892, 0.55991073
LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)
BT709_OF_BT2020 = np.array(
    [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]], np.float32
)


class Transfer(Enum):
    """Transfer function of an HDR picture; the value is its number in ITU-T H.273."""

    PQ = 16
    HLG = 18


class ToneMapping:
    """Tone mapping of pictures with one transfer function.

    Args:
        transfer: The transfer function.
    """

    def __init__(self, transfer: Transfer) -> None:
        self._is_hlg = transfer is Transfer.HLG
        signal = np.arange(CODES) / (CODES - 1)
        # Light relative to PEAK. HLG's is that of the scene.
        light = _scene_light(signal) if self._is_hlg else _light_of_pq(signal) / PEAK
        self._light = light.astype(np.float32)
        # Roots of light as indices resolve the dark codes.
        self._code = np.round(255.0 * _shown(PEAK * signal**2)).astype(np.uint8)

    def __call__(self, signal: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """Map R'G'B' (H, W, 3), 65535 for 1, to codes (H, W, 3)."""
        import cv2

        light = self._light[signal]
        if self._is_hlg:
            light *= np.power(light @ LUMINANCE, 0.2)[..., None]
        light = cv2.transform(light, BT709_OF_BT2020)
        return self._code[np.round(np.sqrt(np.clip(light, 0.0, 1.0)) * (CODES - 1)).astype(np.uint16)]


def _light_of_pq(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the light [cd/m²] of PQ codes in [0, 1]."""
    power = signal ** (1 / M2)
    return 10_000.0 * (np.maximum(power - C1, 0.0) / (C2 - C3 * power)) ** (1 / M1)


def _pq_of_light(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the PQ codes in [0, 1] of light [cd/m²]."""
    power = (light / 10_000.0) ** M1
    return ((C1 + C2 * power) / (1.0 + C3 * power)) ** M2


def _scene_light(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the light of the scene, in [0, 1], of HLG codes in [0, 1]."""
    return np.where(signal <= 0.5, signal**2 / 3.0, (np.exp((signal - C) / A) + B) / 12.0)


def _shown(light: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the code in [0, 1] of light up to PEAK [cd/m²], by the EETF of BT.2390 and BT.1886."""
    of_peak, of_white = _pq_of_light(np.array([PEAK, WHITE]))
    code, most = _pq_of_light(light) / of_peak, of_white / of_peak
    knee = 1.5 * most - 0.5
    t = (code - knee) / (1.0 - knee)
    spline = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1.0 - knee) + (3 * t**2 - 2 * t**3) * most
    mapped = _light_of_pq(np.where(code < knee, code, spline) * of_peak)
    return np.clip(mapped / WHITE, 0.0, 1.0) ** (1 / 2.4)
