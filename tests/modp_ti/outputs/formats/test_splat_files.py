"""Splats of any format are read as an independent reader reads them, and converted from one to another."""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from modp_ti.commands.app import app
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.splat_files import convert_splats, read_any_splats
from modp_ti.outputs.formats.splats_ply import read_splats, write_splats
from modp_ti.outputs.formats.spz import write_spz
from modp_ti.outputs.playback.splat_file import open_splats
from tests.modp_ti.outputs.formats.splat_readers import READERS, logit
from tests.modp_ti.outputs.formats.test_compressed_splats import matched, splats
from tests.modp_ti.outputs.formats.test_sog import clustered

NAMES = {
    "splat": "a.splat",
    "spz": "a.spz",
    "sog": "a.sog",
    "compressed-ply": "a.compressed.ply",
    "ksplat": "a.ksplat",
}


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    write_splats(tmp_path / "source.ply", clustered(700, degree=3))
    return tmp_path / "source.ply"


def same_rotation(a: NDArray, b: NDArray) -> float:
    """Smallest cosine of half the angle between rotations."""
    a, b = (q / np.linalg.norm(q, axis=1, keepdims=True) for q in (a, b))
    return float(np.abs((a * b).sum(axis=1)).min())


def assert_same(ours: dict, theirs: dict) -> None:
    for name in ("position", "log_scale", "opacity_logit", "sh"):
        np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-5, atol=1e-5, err_msg=name)
    assert same_rotation(ours["quaternion"], theirs["quaternion"]) > 1 - 1e-6


@pytest.mark.parametrize("form", NAMES)
def test_a_file_is_read_as_an_independent_reader_reads_it(ply: Path, tmp_path: Path, form: str) -> None:
    convert_splats(ply, tmp_path / "new" / NAMES[form])
    assert_same(read_any_splats(tmp_path / "new" / NAMES[form]), READERS[form](tmp_path / "new" / NAMES[form]))


@pytest.mark.parametrize("version", [2, 3, 4])
def test_every_version_of_spz_is_read_as_an_independent_reader_reads_it(tmp_path: Path, version: int) -> None:
    state = splats(300, degree=1)
    write_spz(tmp_path / "a.spz", state, version)
    theirs = READERS["spz"](tmp_path / "a.spz")
    assert_same(read_any_splats(tmp_path / "a.spz"), theirs)
    turned = same_rotation(matched(state, theirs)["quaternion"], state["quaternion"])
    assert turned > np.cos({2: 0.3, 3: 0.005, 4: 0.005}[version] / 2)  # w of version 2 follows from three bytes


def test_the_first_version_of_spz_is_read(tmp_path: Path) -> None:
    """Written here from its layout: positions in half precision, the quaternion's x, y, z in bytes."""
    content = struct.pack("<3I4B", 0x5053474E, 1, 1, 0, 12, 0, 0) + np.array([1.5, -2.25, 0.125], "<f2").tobytes()
    content += bytes([128, 255, 128, 0, 160, 144, 128, 255, 128, 128])
    (tmp_path / "a.spz").write_bytes(gzip.compress(content))
    state = read_any_splats(tmp_path / "a.spz")
    np.testing.assert_allclose(state["position"], [[1.5, 2.25, -0.125]])
    np.testing.assert_allclose(state["log_scale"], [[0, -1, -2]], atol=1e-6)
    np.testing.assert_allclose(state["opacity_logit"], logit(np.array([128 / 255])), rtol=1e-6)
    np.testing.assert_allclose(state["quaternion"], [[0, 1, 0, 0]], atol=0.01)
    np.testing.assert_allclose(state["sh"][0, 0], [(c / 255 - 0.5) / 0.15 for c in (255, 128, 0)], rtol=1e-5)


def test_a_ksplat_holds_the_splats_up_to_degree_2(ply: Path, tmp_path: Path) -> None:
    convert_splats(ply, tmp_path / "a.ksplat")
    here, there = read_splats(ply), matched(read_splats(ply), READERS["ksplat"](tmp_path / "a.ksplat"))
    small = np.exp(np.quantile(here["log_scale"].max(axis=1), 0.05))
    assert np.abs(there["position"] - here["position"]).max() < 0.02 * small
    np.testing.assert_allclose(there["log_scale"], here["log_scale"], atol=1e-3)
    np.testing.assert_allclose(there["sh"][:, 1:], here["sh"][:, 1:9], rtol=1e-3, atol=1e-4)
    assert np.abs(there["sh"][:, 0] - here["sh"][:, 0]).max() < 0.51 / 255 / 0.2821
    assert same_rotation(there["quaternion"], here["quaternion"]) > 1 - 1e-5


@pytest.mark.filterwarnings("error")
def test_huge_splats_are_the_largest_that_a_ksplat_holds(tmp_path: Path) -> None:
    state = splats(5, degree=1)
    state["log_scale"][0] = 80.0
    write_splats(tmp_path / "a.ply", state)
    convert_splats(tmp_path / "a.ply", tmp_path / "a.ksplat")
    back = read_any_splats(tmp_path / "a.ksplat")["log_scale"]
    assert back.max() == pytest.approx(np.log(65504), abs=1e-3)


@pytest.mark.parametrize(("origin", "noted"), [(0.0, False), (100.0, False), (1e5, True)])
def test_a_map_far_from_the_origin_is_noted_where_spz_moves_its_splats(
    tmp_path: Path, origin: float, noted: bool
) -> None:
    state = splats(200)
    state["position"] += np.float32(origin)
    note = write_spz(tmp_path / "a.spz", state)
    moved = np.abs(read_any_splats(tmp_path / "a.spz")["position"] - state["position"]).max()
    small = np.exp(np.quantile(state["log_scale"].max(axis=1), 0.05))
    assert bool(note) == noted == (moved > small / 8)
    notes: list[str] = []
    write_splats(tmp_path / "a.ply", state)
    convert_splats(tmp_path / "a.ply", tmp_path / "b.spz", note=notes.append)
    assert notes == ([note] if noted else [])


def test_an_option_of_another_format_is_refused(ply: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["convert", str(ply), str(tmp_path / "a.ply"), "--spz-version", "3"])
    assert result.exit_code == 2 and result.stderr.startswith("error: --spz-version: ")


@pytest.mark.parametrize("level", [0, 1, 2])
def test_every_level_of_ksplat_is_read(tmp_path: Path, level: int) -> None:
    """Written here from the layout: two sections of four Gaussians, in a full bucket and a partly filled one."""
    number = "<f4" if level == 0 else "<f2"
    header, headers, content = bytearray(4096), b"", b""
    struct.pack_into("<BBxx4IH", header, 0, 0, 1, 2, 2, 8, 8, level)
    struct.pack_into("<2f", header, 36, -2.0, 1.0)
    positions = []
    for section in range(2):
        one = bytearray(1024)
        struct.pack_into("<4IfH", one, 0, 4, 4, 3, 2 if level else 0, 8.0, 12)
        struct.pack_into("<I4xIIH", one, 24, 0, 1 if level else 0, 1 if level else 0, 1)
        headers += one
        centres = np.array([[1, 2, 3], [-5, section, 0]], "<f4")
        if level:
            content += struct.pack("<I", 1) + centres.tobytes()
        for n in range(4):
            code = np.array([32767, 0, 65534]) if n != 1 else np.array([49150, 32767, 32767])
            place = (code - 32767) * 4.0 / 32767 + centres[n // 3]
            positions.append(place)
            content += (place.astype("<f4") if level == 0 else code.astype("<u2")).tobytes()
            content += np.array([0.5, 1, 0.25, 0.8, 0, 0.6, 0], number).tobytes() + bytes([255, 0, 51, 204])
            harmonics = np.arange(9) / 8 - 0.5
            content += (
                np.round((harmonics + 2) / 3 * 255).astype(np.uint8) if level == 2 else harmonics.astype(number)
            ).tobytes()
    (tmp_path / "a.ksplat").write_bytes(bytes(header) + headers + content)
    state = read_any_splats(tmp_path / "a.ksplat")
    np.testing.assert_allclose(state["position"], positions, atol=1e-4)
    np.testing.assert_allclose(state["log_scale"], np.log([[0.5, 1, 0.25]] * 8), atol=1e-6)
    np.testing.assert_allclose(state["quaternion"], [[0.8, 0, 0.6, 0]] * 8, atol=1e-3)
    np.testing.assert_allclose(state["opacity_logit"], logit(np.full(8, 0.8)), rtol=1e-5)
    np.testing.assert_allclose(state["sh"][0, 0], (np.array([1, 0, 0.2]) - 0.5) / 0.28209479, rtol=1e-5)
    # Red, green and blue of the three harmonics, one colour after the other in the file.
    np.testing.assert_allclose(state["sh"][5, 1:], (np.arange(9) / 8 - 0.5).reshape(3, 3).T, atol=0.51 * 3 / 255)


def read_glb(path: Path) -> dict[str, NDArray]:
    """Read a GLB of splats from the layout of glTF 2.0 and KHR_gaussian_splatting, in axes right, down, ahead."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    document = json.loads(data[20 : 20 + size])
    assert struct.unpack_from("<I4s", data, 20 + size) == (document["buffers"][0]["byteLength"], b"BIN\0")
    primitive = document["meshes"][0]["primitives"][0]
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert primitive["mode"] == 0 and document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")

    def attribute(name: str) -> NDArray:
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        start = 28 + size + view["byteOffset"]
        values = np.frombuffer(data, kind, accessor["count"] * width, start).reshape(-1, width)
        assert values.nbytes == view["byteLength"] and view["byteOffset"] % 4 == 0
        if "min" in accessor:
            np.testing.assert_array_equal(values.min(axis=0), np.float32(accessor["min"]))
        return values

    rest = [f"SH_DEGREE_{degree}_COEF_{n}" for degree in (0, 1, 2, 3) for n in range(2 * degree + 1)]
    sh = np.stack([attribute(f"KHR_gaussian_splatting:{name}") for name in rest], axis=1).copy()
    sh[:, [1, 2, 4, 7, 9, 11, 12, 14]] *= -1  # odd in y and z together
    x, y, z, w = attribute("KHR_gaussian_splatting:ROTATION").T
    opacity = attribute("KHR_gaussian_splatting:OPACITY")[:, 0]
    np.testing.assert_allclose(attribute("COLOR_0")[:, 3] / 255, opacity, atol=0.51 / 255)
    return {
        "position": attribute("POSITION") * [1, -1, -1],
        "log_scale": np.log(attribute("KHR_gaussian_splatting:SCALE")),
        # Multiplied from the left by the quaternion (0, -1, 0, 0), w first.
        "quaternion": np.stack([x, -w, z, -y], axis=1),
        "opacity_logit": logit(opacity),
        "sh": sh,
    }


def test_a_glb_holds_the_splats_turned_with_y_up(ply: Path, tmp_path: Path) -> None:
    convert_splats(ply, tmp_path / "a.glb")
    there, here = read_glb(tmp_path / "a.glb"), read_splats(ply)
    assert_same(there, here)


def test_converted_there_and_back_nothing_is_lost_in_a_ply(ply: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["convert", str(ply), str(tmp_path / "b.ply"), "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["gaussians"] == 700
    assert (tmp_path / "b.ply").read_bytes() == ply.read_bytes()
    assert b"comment SplatRenderMode: mip\n" in ply.read_bytes()[:200]


@pytest.mark.parametrize(
    ("source", "target", "part"),
    [
        ("source.ply", "b.obj", "splats are written to a file in .compressed.ply, .ply, .spz"),
        ("source.ply", "source.ply", "is the source itself"),
        ("gone.spz", "b.ply", "cannot be read: No such file"),
        ("text.txt", "b.ply", "splats are read from .ply, .spz, .sog, .splat, .ksplat"),
    ],
)
def test_what_cannot_be_converted_is_refused_in_one_line(ply: Path, source: str, target: str, part: str) -> None:
    folder = ply.parent
    result = CliRunner().invoke(app, ["convert", str(folder / source), str(folder / target)])
    assert result.exit_code == 2 and result.stderr.count("\n") == 1
    assert part in result.stderr


@pytest.mark.parametrize("form", NAMES)
@pytest.mark.parametrize("version", [3, 4])
def test_a_damaged_file_is_refused(ply: Path, tmp_path: Path, form: str, version: int) -> None:
    convert_splats(ply, tmp_path / NAMES[form], version)
    whole = (tmp_path / NAMES[form]).read_bytes()
    rng = np.random.default_rng(0)
    cuts = [0, 3, 20, len(whole) // 2 + 1, len(whole) - 5]
    for cut in cuts:
        (tmp_path / NAMES[form]).write_bytes(whole[:cut])
        with pytest.raises(InputError):
            read_any_splats(tmp_path / NAMES[form])
    for _ in range(20):
        changed = bytearray(whole)
        for place in rng.integers(0, min(len(whole), 400), 4):
            changed[place] = rng.integers(256)
        (tmp_path / NAMES[form]).write_bytes(changed)
        try:
            state = read_any_splats(tmp_path / NAMES[form])
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert all(np.isfinite(values).all() for values in state.values())


def test_a_file_of_splats_is_seen_whole_from_the_start(ply: Path) -> None:
    run = open_splats(ply)
    inside = run.gaussians["position"] @ run.poses[0, :3, :3].T + run.poses[0, :3, 3]
    camera = run.cameras[0]
    pixels = inside[:, :2] / inside[:, 2:] * camera.fx + [camera.cx, camera.cy]
    seen = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1) & (inside[:, 2] > run.record.near)
    assert seen.mean() > 0.7
