"""`.sog`, read back by a reader written from the published layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from modp_ti.outputs.formats.sog import codebook, write_sog
from tests.modp_ti.outputs.formats.splat_readers import read_sog
from tests.modp_ti.outputs.formats.test_compressed_splats import matched, splats


def clustered(count: int, degree: int) -> dict[str, NDArray[np.float32]]:
    """Gaussians with harmonics around 20 centres, as those of neighbours on a surface are alike."""
    state = splats(count, degree)
    rng = np.random.default_rng(1)
    centres = rng.uniform(-0.9, 0.9, (20, (degree + 1) ** 2 - 1, 3))
    state["sh"][:, 1:] = centres[np.arange(count) % 20] + rng.normal(0, 0.02, (count, *centres.shape[1:]))
    return state


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_what_is_read_back_is_what_was_written_to_its_last_bits(tmp_path: Path, degree: int) -> None:
    state = clustered(1500, degree)
    write_sog(tmp_path / "file", state)
    back = matched(state, read_sog(tmp_path / "file"))
    # Half a step of log(1 + |v|) in 16 bits, from -log(4) to log(4), where the slope is 4.
    np.testing.assert_allclose(back["position"], state["position"], rtol=0, atol=1.1 * 4 * np.log(4) / 65535)
    # Ranges of 4.6 and 3.4 in 256 codes, of which half are spread evenly.
    np.testing.assert_allclose(back["log_scale"], state["log_scale"], rtol=0, atol=4.6 / 127)
    np.testing.assert_allclose(back["sh"][:, 0], state["sh"][:, 0], rtol=0, atol=3.4 / 127)
    opacity, read = (1 / (1 + np.exp(-s["opacity_logit"])) for s in (state, back))
    np.testing.assert_allclose(read, opacity, rtol=0, atol=0.51 / 255)
    turn = Rotation.from_quat(back["quaternion"], scalar_first=True).inv() * Rotation.from_quat(
        state["quaternion"], scalar_first=True
    )
    assert turn.magnitude().max() < 0.02  # half a step of sqrt(2) / 255 in three components: 2 x sqrt(12) of it
    if degree:
        error = back["sh"][:, 1:] - state["sh"][:, 1:]
        assert error.std() < 0.1 * state["sh"][:, 1:].std()


def test_harmonics_take_about_the_nearest_entry_of_the_palette(tmp_path: Path) -> None:
    state = splats(600, degree=1)
    write_sog(tmp_path / "file", state)
    back = matched(state, read_sog(tmp_path / "file"))
    there, here = (s["sh"][:, 1:].reshape(600, -1).astype(np.float64) for s in (back, state))
    entries = np.unique(there, axis=0)
    assert 20 < len(entries) <= 600 // 16
    distance = np.linalg.norm(here[:, None] - entries, axis=2)
    own = np.linalg.norm(here - there, axis=1)
    # But for a last round of means, and the codebook of the palette itself.
    assert own.mean() <= 1.1 * distance.min(axis=1).mean()
    assert own.mean() < 0.8 * np.linalg.norm(here - here.mean(axis=0), axis=1).mean()


def test_a_codebook_keeps_few_numbers_exactly_and_misses_many_by_little() -> None:
    rng = np.random.default_rng(2)
    few = rng.normal(size=100)
    codes, index = codebook(np.tile(few, 5))
    assert np.abs(codes[index] - np.tile(few, 5)).max() < np.ptp(few) / 254
    many = rng.normal(size=20000)
    codes, index = codebook(many)
    assert (np.diff(codes) >= 0).all()
    assert np.abs(codes[index] - many).max() <= np.ptp(many) / 127
    steps = np.ptp(many) / 255 / np.sqrt(12)  # error of 256 even steps
    assert (codes[index] - many).std() < 0.8 * steps


@pytest.mark.parametrize("count", [0, 1, 17])
def test_small_maps_are_written(tmp_path: Path, count: int) -> None:
    state = splats(count, degree=1)
    write_sog(tmp_path / "file", state)
    back = read_sog(tmp_path / "file") if count else None
    first = (tmp_path / "file").read_bytes()
    write_sog(tmp_path / "file", state)
    assert (tmp_path / "file").read_bytes() == first
    assert back is None or len(back["position"]) == count


def test_a_file_is_small_and_nothing_is_left_beside_it(tmp_path: Path) -> None:
    state = clustered(5000, degree=1)
    write_sog(tmp_path / "file", state)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").stat().st_size < 19 * 5000
