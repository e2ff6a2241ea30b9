"""The compressed forms of splats, read back by readers written here from their published layouts."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.compressed_ply import write_compressed_ply
from modp_ti.outputs.formats.spz import write_spz
from modp_ti.outputs.formats.web_splat import write_web_splat
from tests.modp_ti.outputs.formats.splat_readers import READERS
from tests.pipelines.reference import sh_basis

WRITERS = {"splat": write_web_splat, "spz": write_spz, "compressed-ply": write_compressed_ply}
SIZES = {"splat": 32, "spz": 20, "compressed-ply": 16}  # bytes a Gaussian, without harmonics


def splats(count: int, degree: int = 0, scale: float = 1.0) -> dict[str, NDArray[np.float32]]:
    """Gaussians as a map has them: a few units of space, sizes of 0.005 to 0.5, quaternions of any length."""
    rng = np.random.default_rng(5)
    state = {
        "position": scale * rng.uniform(-3, 3, (count, 3)),
        "log_scale": np.log(scale) + rng.uniform(np.log(0.005), np.log(0.5), (count, 3)),
        "quaternion": rng.normal(size=(count, 4)) * rng.uniform(0.5, 2, (count, 1)),
        "opacity_logit": rng.uniform(-4, 5, count),
        "sh": np.concatenate(
            [rng.uniform(-1.7, 1.7, (count, 1, 3)), rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2 - 1, 3))], axis=1
        ),
    }
    return {name: values.astype(np.float32) for name, values in state.items()}


def matched(written: dict, read: dict) -> dict:
    """What was read, in the order in which it was written."""
    distance = ((written["position"][:, None] - read["position"]) ** 2).sum(axis=2)
    order = distance.argmin(axis=1)
    assert len(set(order.tolist())) == len(order)
    return {name: values[order] for name, values in read.items()}


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_what_is_read_back_is_what_was_written_to_its_last_bits(tmp_path: Path, form: str, degree: int) -> None:
    state = splats(700, degree)
    WRITERS[form](tmp_path / "file", state)
    back = matched(state, READERS[form](tmp_path / "file"))
    # An eighth of the finest size at most; a chunk's extent in 2^10 steps.
    place = {"splat": 0, "spz": 5e-4, "compressed-ply": 6 / 2**11}[form]
    np.testing.assert_allclose(back["position"], state["position"], rtol=0, atol=place)
    size = {"splat": 1e-5, "spz": 0.5 / 16, "compressed-ply": 5 / 2**11}[form]
    np.testing.assert_allclose(back["log_scale"], state["log_scale"], rtol=0, atol=size + 1e-6)
    opacity, read = (1 / (1 + np.exp(-s["opacity_logit"])) for s in (state, back))
    np.testing.assert_allclose(read, opacity, rtol=0, atol=(1.01 if form == "spz" else 0.51) / 255)
    turn = Rotation.from_quat(back["quaternion"], scalar_first=True).inv() * Rotation.from_quat(
        state["quaternion"], scalar_first=True
    )
    # Half a step of 2^-9.5 in three components, of which the fourth follows: at most 2 x sqrt(12) of it.
    assert turn.magnitude().max() < {"splat": 0.02, "spz": 0.005, "compressed-ply": 0.005}[form]
    constant = {"splat": 0.51 / 255 / 0.2820948, "spz": 0.51 / 255 / 0.15, "compressed-ply": 0.51 / 255 * 3.4}[form]
    np.testing.assert_allclose(back["sh"][:, 0], state["sh"][:, 0], rtol=0, atol=constant)
    if form != "splat":
        step = {"spz": 0.5 / 128, "compressed-ply": 0.5 * 8 / 256}[form]
        np.testing.assert_allclose(back["sh"], state["sh"], rtol=0, atol=max(step, constant) * 1.01)


@pytest.mark.parametrize("form", WRITERS)
def test_a_map_of_any_scale_is_kept_alike(tmp_path: Path, form: str) -> None:
    """Monocular scale is arbitrary: sizes of hundredths, or of hundreds."""
    for scale in (0.05, 30.0):
        state = splats(300, scale=scale)
        WRITERS[form](tmp_path / "file", state)
        back = matched(state, READERS[form](tmp_path / "file"))
        assert np.abs(back["position"] - state["position"]).max() < 3e-3 * scale
        assert np.abs(back["log_scale"] - state["log_scale"]).max() < 0.04


@pytest.mark.parametrize("form", WRITERS)
def test_a_file_has_the_size_of_its_layout_and_nothing_is_left_beside_it(tmp_path: Path, form: str) -> None:
    state = splats(2000)
    WRITERS[form](tmp_path / "file", state)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    size = (tmp_path / "file").stat().st_size
    assert 0.7 * SIZES[form] * 2000 < size < SIZES[form] * 2000 + 1500
    first = (tmp_path / "file").read_bytes()
    WRITERS[form](tmp_path / "file", state)
    assert (tmp_path / "file").read_bytes() == first


def test_the_most_important_gaussians_come_first_in_splat(tmp_path: Path) -> None:
    state = splats(100)
    write_web_splat(tmp_path / "file", state)
    back = READERS["splat"](tmp_path / "file")
    importance = np.exp(back["log_scale"].sum(axis=1)) / (1 + np.exp(-back["opacity_logit"]))
    assert importance[0] > importance[50] > importance[-1]
    assert importance[0] == pytest.approx(importance.max(), rel=0.05)


def test_neighbours_share_a_chunk_of_the_compressed_ply(tmp_path: Path) -> None:
    """So that its range is small, and 11 bits go far."""
    state = splats(256 * 16)
    write_compressed_ply(tmp_path / "file", state)
    chunks = READERS["compressed-ply"](tmp_path / "file")["position"].reshape(16, 256, 3)
    assert np.median(np.ptp(chunks, axis=1).prod(axis=1)) < 0.2 * 6.0**3


def test_harmonics_of_spz_give_the_same_colours_from_the_turned_direction(tmp_path: Path) -> None:
    """Read as stored, in axes right, up, back: against the polynomials themselves."""
    state = splats(40, degree=3)
    write_spz(tmp_path / "file", state)
    data = gzip.decompress((tmp_path / "file").read_bytes())
    stored = (np.frombuffer(data, np.uint8)[-40 * 45 :].reshape(40, 15, 3).astype(np.float64) - 128) / 128
    directions = np.random.default_rng(0).normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here = np.einsum("nk,nkc->nc", sh_basis(3, directions)[:, 1:], state["sh"][:, 1:])
    there = np.einsum("nk,nkc->nc", sh_basis(3, directions * [1, -1, -1])[:, 1:], stored)
    np.testing.assert_allclose(there, here, rtol=0, atol=0.03)
    assert np.abs(here).max() > 0.5


def test_what_spz_cannot_hold_is_refused(tmp_path: Path) -> None:
    state = splats(3)
    state["position"][1] = 1e8
    with pytest.raises(InputError, match=r"beyond what \.spz holds"):
        write_spz(tmp_path / "file", state)
    assert not list(tmp_path.iterdir())
