"""HDR is mapped as the standards' formulas say, here in float64 and without tables."""

from __future__ import annotations

import numpy as np
import pytest

from modp_ti.inputs.sources.tone_mapping import ToneMapping, Transfer


def by_formula(signal: np.ndarray, transfer: Transfer) -> np.ndarray:
    """R'G'B' in [0, 1] to codes from 0 to 255."""
    if transfer is Transfer.PQ:
        light = pq_light(signal)
    else:
        a = 0.17883277
        b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
        scene = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
        light = 1000 * scene * (scene @ [0.2627, 0.6780, 0.0593])[..., None] ** 0.2
    light = light @ (np.linalg.inv(to_xyz(BT709)) @ to_xyz(BT2020)).T
    code = pq_code(np.clip(light, 0, 1000)) / pq_code(1000.0)
    white = pq_code(203.0) / pq_code(1000.0)
    knee = 1.5 * white - 0.5
    t = (code - knee) / (1 - knee)
    spline = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (-2 * t**3 + 3 * t**2) * white
    shown = pq_light(np.where(code < knee, code, spline) * pq_code(1000.0))
    return 255 * np.clip(shown / 203, 0, 1) ** (1 / 2.4)


def pq_light(code: np.ndarray) -> np.ndarray:
    root = code ** (32 / 2523)
    return 10000 * (np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)) ** (1 / 0.1593017578125)


def pq_code(light: np.ndarray | float) -> np.ndarray:
    power = (np.asarray(light) / 10000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


BT709 = [(0.64, 0.33), (0.30, 0.60), (0.15, 0.06)]
BT2020 = [(0.708, 0.292), (0.170, 0.797), (0.131, 0.046)]


def to_xyz(primaries: list[tuple[float, float]]) -> np.ndarray:
    """(3, 3) from RGB to XYZ, with the white D65."""
    columns = np.array([[x / y, 1, (1 - x - y) / y] for x, y in primaries]).T
    white = np.array([0.3127 / 0.3290, 1, (1 - 0.3127 - 0.3290) / 0.3290])
    return columns * np.linalg.solve(columns, white)


@pytest.mark.parametrize("transfer", Transfer)
def test_every_colour_is_mapped_as_the_formulas_say(transfer):
    steps = np.linspace(0, 1, 33)
    signal = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(33, -1, 3)
    codes = np.round(signal * 65535).astype(np.uint16)
    expected = by_formula(codes / 65535, transfer)
    assert np.abs(ToneMapping(transfer)(codes) - expected).max() <= 0.51 + 0.3  # rounding, and the table's steps


@pytest.mark.parametrize("transfer", Transfer)
def test_brighter_grey_is_never_darker_and_no_code_is_left_out(transfer):
    grey = np.repeat(np.arange(65536, dtype=np.uint16)[None, :, None], 3, axis=2)
    codes = ToneMapping(transfer)(grey)[0].astype(int)
    assert np.ptp(codes, axis=1).max() <= 1, "grey stays grey"
    assert set(np.diff(codes[:, 1])) == {0, 1}
    assert codes[0].max() == 0 and codes[-1].min() == 255
