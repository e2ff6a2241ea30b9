from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from plyfile import PlyData

from modp_ti.files.errors import InputError
from modp_ti.outputs.formats import splats_ply
from modp_ti.outputs.formats.splats_ply import check_splats, read_splats, write_splats


def splats(count: int, sh_count: int) -> dict[str, NDArray[np.float32]]:
    rng = np.random.default_rng(sh_count)
    shapes = {"position": (3,), "log_scale": (3,), "quaternion": (4,), "opacity_logit": (), "sh": (sh_count, 3)}
    return {name: rng.normal(size=(count, *shape)).astype(np.float32) for name, shape in shapes.items()}


@pytest.mark.parametrize("sh_count", [1, 4, 16])
def test_what_is_written_is_read_back_bit_for_bit(tmp_path: Path, sh_count: int) -> None:
    state = splats(17, sh_count)
    write_splats(tmp_path / "splats.ply", state)
    back = read_splats(tmp_path / "splats.ply")
    assert back.keys() == state.keys()
    for name, values in state.items():
        np.testing.assert_array_equal(back[name], values)
    assert [p.name for p in tmp_path.iterdir()] == ["splats.ply"]


@pytest.mark.parametrize("damage", ["changed", "cut", "longer"])
def test_a_file_that_is_not_what_was_written_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    monkeypatch.setattr(splats_ply, "ROWS_EACH", 5)  # so that there are several pieces
    path, state = tmp_path / "splats.ply", splats(17, 4)
    write_splats(path, state)
    check_splats(path, state)
    content = bytearray(path.read_bytes())
    content[-70] ^= 1
    path.write_bytes({"changed": content, "cut": path.read_bytes()[:-8], "longer": path.read_bytes() + b"0"}[damage])
    with pytest.raises(InputError, match=r"splats\.ply: is not read back as it was written"):
        check_splats(path, state)


def test_another_reader_finds_the_3dgs_layout(tmp_path: Path) -> None:
    state = splats(5, 9)
    write_splats(tmp_path / "splats.ply", state)
    vertex = PlyData.read(tmp_path / "splats.ply")["vertex"]
    assert [p.name for p in vertex.properties][:9] == [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    np.testing.assert_array_equal(vertex["y"], state["position"][:, 1])
    np.testing.assert_array_equal(vertex["opacity"], state["opacity_logit"])
    np.testing.assert_array_equal(vertex["scale_2"], state["log_scale"][:, 2])
    np.testing.assert_array_equal(vertex["rot_0"], state["quaternion"][:, 0])
    # All eight coefficients of red come before those of green.
    np.testing.assert_array_equal(vertex["f_rest_7"], state["sh"][:, 8, 0])
    np.testing.assert_array_equal(vertex["f_rest_8"], state["sh"][:, 1, 1])


def test_no_gaussians_make_a_file_that_is_read_back(tmp_path: Path) -> None:
    write_splats(tmp_path / "splats.ply", splats(0, 1))
    assert read_splats(tmp_path / "splats.ply")["sh"].shape == (0, 1, 3)


def test_infinite_opacity_logits_are_read_as_opaque_and_transparent(tmp_path: Path) -> None:
    """Other programs write them for the largest and the least opacity that eight bits hold."""
    written = splats(3, 4)
    written["opacity_logit"][:2] = np.inf, -np.inf
    write_splats(tmp_path / "splats.ply", written)
    opacity = 1.0 / (1.0 + np.exp(-read_splats(tmp_path / "splats.ply")["opacity_logit"].astype(np.float64)))
    np.testing.assert_allclose(opacity[:2], [1.0, 0.0], atol=0.5 / 255 + 1e-6)
    written["opacity_logit"][2] = np.nan
    write_splats(tmp_path / "splats.ply", written)
    with pytest.raises(InputError, match="Gaussian 2 holds NaN"):
        read_splats(tmp_path / "splats.ply")


def test_a_file_cut_short_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "splats.ply"
    write_splats(path, splats(9, 1))
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"splats\.ply: the PLY file is damaged or cut off"):
        read_splats(path)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"no ply at all", "not a PLY file"),
        (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "not a binary little-endian PLY"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n", "y does not fit"),
    ],
)
def test_what_holds_no_splats_is_refused(tmp_path: Path, content: bytes, complaint: str) -> None:
    path = tmp_path / "other.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=complaint):
        read_splats(path)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_splats(tmp_path / "none.ply")
