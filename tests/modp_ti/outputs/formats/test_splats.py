"""Every format of splats holds the map to its last bits, for readers written from the published layouts."""

from __future__ import annotations

import json
import zipfile
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fields.map.blocks import extent_of
from modp_ti.files.errors import InputError
from modp_ti.outputs.formats import splats_ply
from modp_ti.outputs.formats.compressed_splats import write_compressed_ply, write_spz, write_web_splat
from modp_ti.outputs.formats.gltf import write_splat_glb
from modp_ti.outputs.formats.sog import codebook, write_sog, write_sog_lod
from modp_ti.outputs.formats.splats_ply import check_splats, read_splats, write_splats
from modp_ti.outputs.formats.usd import USD_SUFFIXES, write_usd
from modp_ti.outputs.playback.finished_run import open_splats
from pipelines.whole.hierarchy import LEVELS, Hierarchy
from tests.modp_ti.outputs.formats.splat_readers import ODD, READERS, read_sog
from tests.pipelines.reference import sh_basis

C0, FLOAT = 0.2820948, 1e-5
FILE = "map.usdc"  # only usd asks for a suffix
WRITERS = {
    "ply": write_splats,
    "splat": write_web_splat,
    "spz": write_spz,
    "spz 2": partial(write_spz, version=2),
    "spz 4": partial(write_spz, version=4),
    "sog": write_sog,
    "compressed-ply": write_compressed_ply,
    "splat-glb": write_splat_glb,
    **({"usd": write_usd} if find_spec("pxr") else {}),
}


class Bound(NamedTuple):
    """Largest difference of a format, for positions in 6 units, log scales over 4.6 and constant harmonics over 3.4."""

    position: float
    log_scale: float
    opacity: float  # of one
    turn: float  # [rad]
    constant: float
    rest: float | None  # None where there are none
    size: int  # of a Gaussian of degree 0 [bytes]


EXACT = Bound(0, 0, 0, 2e-4, 0, 0, 68)
# Positions of spz: an eighth of the finest size at most. Rotations: half a step of 2^-9.5 in three components, of which
# the fourth follows, at most 2 x sqrt(12) of it; w of version 2 follows from three bytes.
SPZ = Bound(5e-4, 0.5 / 16 + 1e-6, 1.01 / 255, 0.005, 0.51 / 255 / 0.15, 0.5 / 128, 20)
BOUNDS = {
    "ply": EXACT,
    "splat": Bound(0, FLOAT, 0.51 / 255, 0.02, 0.51 / 255 / C0, None, 32),
    "spz": SPZ,
    "spz 2": SPZ._replace(turn=0.3, size=19),
    "spz 4": SPZ,
    # A chunk's extent in 2^10 steps.
    "compressed-ply": Bound(6 / 2**11, 5 / 2**11, 0.51 / 255, 0.005, 0.51 / 255 * 3.4, 0.5 * 8 / 256, 16),
    # Half a step of log(1 + |v|) in 16 bits, from -log(4) to log(4), where the slope is 4; 256 codes, of which half are
    # spread evenly. Harmonics come from a palette, which has a test of its own.
    "sog": Bound(1.1 * 4 * np.log(4) / 65535, 4.6 / 127, 0.51 / 255, 0.02, 3.4 / 127, 2.0, 19),
    "splat-glb": EXACT._replace(log_scale=FLOAT, opacity=FLOAT, size=60),
    "usd": EXACT._replace(log_scale=FLOAT, opacity=FLOAT, size=56),
}


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


def clustered(count: int, degree: int) -> dict[str, NDArray[np.float32]]:
    """Gaussians with harmonics around 20 centres, as those of neighbours on a surface are alike."""
    state = splats(count, degree)
    rng = np.random.default_rng(1)
    centres = rng.uniform(-0.9, 0.9, (20, (degree + 1) ** 2 - 1, 3))
    state["sh"][:, 1:] = centres[np.arange(count) % 20] + rng.normal(0, 0.02, (count, *centres.shape[1:]))
    return state


def matched(written: dict, read: dict) -> dict:
    """What was read, in the order in which it was written."""
    distance = ((written["position"][:, None] - read["position"]) ** 2).sum(axis=2)
    order = distance.argmin(axis=1)
    assert len(set(order.tolist())) == len(order)
    return {name: values[order] for name, values in read.items()}


def written(form: str, state: dict, path: Path) -> dict[str, NDArray]:
    """What an independent reader reads of a file of this format, in the order of `state`."""
    WRITERS[form](path, state)
    return matched(state, READERS[form.partition(" ")[0]](path))


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("form", WRITERS)
def test_what_another_reader_reads_is_what_was_written_to_its_last_bits(tmp_path: Path, form: str, degree: int) -> None:
    state, bound = splats(700, degree), BOUNDS[form]
    back = written(form, state, tmp_path / FILE)
    opacity, read = (1 / (1 + np.exp(-s["opacity_logit"].astype(float))) for s in (state, back))
    turn = Rotation.from_quat(back["quaternion"], scalar_first=True).inv() * Rotation.from_quat(
        state["quaternion"], scalar_first=True
    )
    differences = {
        "position": back["position"] - state["position"],
        "log_scale": back["log_scale"] - state["log_scale"],
        "opacity": read - opacity,
        "turn": turn.magnitude(),
        "constant": back["sh"][:, 0] - state["sh"][:, 0],
    }
    if bound.rest is not None:
        assert back["sh"].shape == state["sh"].shape
        differences["rest"] = back["sh"][:, 1:] - state["sh"][:, 1:]
    for name, difference in differences.items():
        assert np.abs(difference).max(initial=0) <= 1.01 * getattr(bound, name), name


@pytest.mark.parametrize("form", WRITERS)
def test_maps_of_any_scale_and_size_are_kept(tmp_path: Path, form: str) -> None:
    """Monocular scale is arbitrary: sizes of hundredths, or of hundreds."""
    for scale in (0.05, 30.0):
        state = splats(300, scale=scale)
        back = written(form, state, tmp_path / FILE)
        assert np.abs(back["position"] - state["position"]).max() < 3e-3 * scale
        assert np.abs(back["log_scale"] - state["log_scale"]).max() < 0.04
    for count in (0, 1, 17):
        WRITERS[form](tmp_path / FILE, splats(count, degree=1))
        assert not count or len(READERS[form.partition(" ")[0]](tmp_path / FILE)["position"]) == count


@pytest.mark.parametrize("form", WRITERS)
def test_a_map_gives_one_file_of_the_size_of_its_layout(tmp_path: Path, form: str) -> None:
    state, size = splats(2000), BOUNDS[form].size
    WRITERS[form](tmp_path / FILE, state)
    assert [p.name for p in tmp_path.iterdir()] == [FILE]
    first = (tmp_path / FILE).read_bytes()
    assert 0.6 * size * 2000 < len(first) < size * 2000 + 4000
    WRITERS[form](tmp_path / FILE, state)
    assert (tmp_path / FILE).read_bytes() == first


# ---- what single formats promise ---------------------------------------------------------------------------------


def test_the_most_important_gaussians_come_first_in_splat(tmp_path: Path) -> None:
    write_web_splat(tmp_path / FILE, splats(100))
    back = READERS["splat"](tmp_path / FILE)
    importance = np.exp(back["log_scale"].sum(axis=1)) / (1 + np.exp(-back["opacity_logit"]))
    assert importance[0] > importance[50] > importance[-1]
    assert importance[0] == pytest.approx(importance.max(), rel=0.05)


@pytest.mark.parametrize("sky", [0, 200])
def test_neighbours_share_a_chunk_of_the_compressed_ply(tmp_path: Path, sky: int) -> None:
    """So that its range is small, and 11 bits go far. What is far away shares none with what is near."""
    state = splats(256 * 16)
    state["position"][:sky] *= 50 / np.linalg.norm(state["position"][:sky], axis=1, keepdims=True)
    write_compressed_ply(tmp_path / FILE, state)
    chunks = READERS["compressed-ply"](tmp_path / FILE)["position"].reshape(16, 256, 3)
    assert np.median(np.ptp(chunks, axis=1).prod(axis=1)) < 0.2 * 6.0**3


def test_the_signs_of_turned_harmonics_are_those_of_the_polynomials() -> None:
    """Which degrees are odd in y and z together, in `spz` and `splat-glb`: against the polynomials themselves."""
    directions = np.random.default_rng(0).normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turned = sh_basis(3, directions * [1, -1, -1])
    signs = np.ones(16)
    signs[ODD] = -1
    np.testing.assert_allclose(turned, sh_basis(3, directions) * signs, atol=1e-12)


@pytest.mark.parametrize(("origin", "noted"), [(0.0, False), (100.0, False), (1e5, True), (1e8, None)])
def test_a_map_far_from_the_origin_is_noted_where_spz_moves_its_splats(
    tmp_path: Path, origin: float, noted: bool | None
) -> None:
    state = splats(200)
    state["position"] += np.float32(origin)
    if noted is None:  # beyond 24 bits
        with pytest.raises(InputError, match="spz"):
            write_spz(tmp_path / FILE, state)
        return
    note = write_spz(tmp_path / FILE, state)
    moved = np.abs(READERS["spz"](tmp_path / FILE)["position"] - state["position"]).max()
    small = np.exp(np.quantile(state["log_scale"].max(axis=1), 0.05))
    assert bool(note) == noted == (moved > small / 8)


def test_harmonics_take_about_the_nearest_entry_of_the_palette(tmp_path: Path) -> None:
    state = splats(600, degree=1)
    back = written("sog", state, tmp_path / FILE)
    there, here = (s["sh"][:, 1:].reshape(600, -1).astype(np.float64) for s in (back, state))
    entries = np.unique(there, axis=0)
    assert 20 < len(entries) <= 600 // 16
    distance = np.linalg.norm(here[:, None] - entries, axis=2)
    # But for a last round of means, and the codebook of the palette itself.
    assert np.linalg.norm(here - there, axis=1).mean() <= 1.1 * distance.min(axis=1).mean()
    alike = clustered(1500, degree=1)
    error = written("sog", alike, tmp_path / FILE)["sh"][:, 1:] - alike["sh"][:, 1:]
    assert error.std() < 0.1 * alike["sh"][:, 1:].std()


def test_a_codebook_misses_many_numbers_by_less_than_even_steps() -> None:
    many = np.random.default_rng(2).normal(size=20000)
    codes, index = codebook(many)
    assert np.abs(codes[index] - many).max() <= np.ptp(many) / 127
    assert (codes[index] - many).std() < 0.8 * np.ptp(many) / 255 / np.sqrt(12)


def test_usd_passes_its_own_checker_and_bounds_the_map(tmp_path: Path) -> None:
    pytest.importorskip("pxr", reason="the extra usd")
    from pxr import Usd, UsdGeom, UsdValidation

    state = splats(300, degree=2)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    for suffix in USD_SUFFIXES:
        write_usd(tmp_path / f"map{suffix}", state)
        stage = Usd.Stage.Open(str(tmp_path / f"map{suffix}"))
        found = UsdValidation.ValidationContext(validators).Validate(stage)
        assert not [error.GetErrorAsString() for error in found]
        box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(stage.GetPseudoRoot())
        low, high = map(np.array, (box.GetRange().GetMin(), box.GetRange().GetMax()))
        reach = 3 * np.exp(state["log_scale"].max(axis=1, keepdims=True))
        np.testing.assert_allclose(low[0], (state["position"] - reach).min(axis=0)[0], rtol=1e-6)
        np.testing.assert_allclose(high[1], -(state["position"] - reach).min(axis=0)[1], rtol=1e-6)


# ---- streamed SOG ------------------------------------------------------------------------------------------------


def read_chunk(folder: Path, name: str) -> dict[str, NDArray]:
    with zipfile.ZipFile(folder / "chunk.zip", "w") as file:
        for part in (folder / name).parent.iterdir():
            file.write(part, part.name)
    return read_sog(folder / "chunk.zip")


def leaves(node: dict) -> list[dict]:
    """Leaves of a tree, whose boxes lie in those above."""
    assert ("children" in node) != ("lods" in node)
    if "lods" in node:
        return [node]
    below = [leaf for child in node["children"] for leaf in leaves(child)]
    for side, inside in (("min", np.less_equal), ("max", np.greater_equal)):
        assert all(inside(node["bound"][side], leaf["bound"][side]).all() for leaf in below)
    return below


def test_every_leaf_of_streamed_sog_holds_its_block_at_every_level(tmp_path: Path) -> None:
    state = splats(3000, degree=1)
    state["log_scale"] -= 1.5
    hierarchy = Hierarchy(state)
    write_sog_lod(tmp_path, hierarchy, chunk=1000)
    meta = json.loads((tmp_path / "lod-meta.json").read_text())
    assert meta["version"] == 1 and meta["lodLevels"] == LEVELS + 1
    assert meta["counts"] == [len(hierarchy.level(number)) for number in range(LEVELS + 1)]
    assert meta["count"] == sum(meta["counts"]) and meta["counts"][0] == 3000
    chunks = [read_chunk(tmp_path, name) for name in meta["filenames"]]
    used = [np.zeros(len(chunk["position"]), dtype=int) for chunk in chunks]
    found = leaves(meta["tree"])
    assert len(found) == len(hierarchy.blocks)
    for number in range(LEVELS + 1):
        drawn = []
        for leaf in found:
            run = leaf["lods"][str(number)]
            part = slice(run["offset"], run["offset"] + run["count"])
            used[run["file"]][part] += 1
            there = {name: values[part] for name, values in chunks[run["file"]].items()}
            reach = extent_of(there["log_scale"])[:, None]
            # Positions and sizes of a chunk are rounded.
            assert (there["position"] - reach >= np.array(leaf["bound"]["min"]) - 0.02 - 0.05 * reach).all()
            assert (there["position"] + reach <= np.array(leaf["bound"]["max"]) + 0.02 + 0.05 * reach).all()
            drawn.append(there)
        read = {name: np.concatenate([part[name] for part in drawn]) for name in drawn[0]}
        level = hierarchy.level(number)
        of_level = {name: values[level.places] for name, values in level.values.items()}
        back = matched(of_level, read)
        np.testing.assert_allclose(back["position"], of_level["position"], atol=4e-4)
        np.testing.assert_allclose(back["sh"][:, 0], of_level["sh"][:, 0], atol=0.04)
    assert all((count == 1).all() for count in used)
    assert len(chunks) >= 3 + LEVELS


# ---- splats.ply, which is read back ------------------------------------------------------------------------------


@pytest.mark.parametrize("damage", ["changed", "cut", "longer"])
def test_a_file_that_is_not_what_was_written_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    monkeypatch.setattr(splats_ply, "ROWS_EACH", 5)  # so that there are several pieces
    path, state = tmp_path / "splats.ply", splats(17, 1)
    write_splats(path, state)
    check_splats(path, state)
    content = bytearray(path.read_bytes())
    content[-70] ^= 1
    path.write_bytes({"changed": content, "cut": path.read_bytes()[:-8], "longer": path.read_bytes() + b"0"}[damage])
    with pytest.raises(InputError, match=r"splats\.ply"):
        check_splats(path, state)


def test_infinite_opacity_logits_are_read_as_opaque_and_transparent(tmp_path: Path) -> None:
    """Other programs write them for the largest and the least opacity that eight bits hold."""
    state = splats(3, 1)
    state["opacity_logit"][:2] = np.inf, -np.inf
    write_splats(tmp_path / "splats.ply", state)
    opacity = 1.0 / (1.0 + np.exp(-read_splats(tmp_path / "splats.ply")["opacity_logit"].astype(np.float64)))
    np.testing.assert_allclose(opacity[:2], [1.0, 0.0], atol=0.5 / 255 + 1e-6)


@pytest.mark.parametrize(
    "content",
    [
        None,
        "cut",
        "nan",
        b"no ply at all",
        b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty float x\nend_header\n",
    ],
)
def test_what_holds_no_splats_is_refused(tmp_path: Path, content: bytes | str | None) -> None:
    path, state = tmp_path / "other.ply", splats(9)
    if content is not None:
        state["opacity_logit"][2] = np.nan
        write_splats(path, state)
        data = {"cut": path.read_bytes()[:-20], "nan": path.read_bytes()}
        path.write_bytes(content if isinstance(content, bytes) else data[content])
    with pytest.raises(InputError, match=r"other\.ply"):
        read_splats(path)


def test_a_file_of_splats_is_seen_whole_from_the_start(tmp_path: Path) -> None:
    write_splats(tmp_path / "source.ply", splats(700))
    run = open_splats(tmp_path / "source.ply")
    inside = run.gaussians["position"] @ run.poses[0, :3, :3].T + run.poses[0, :3, 3]
    camera = run.cameras[0]
    pixels = inside[:, :2] / inside[:, 2:] * camera.fx + [camera.cx, camera.cy]
    seen = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(axis=1) & (inside[:, 2] > run.record.near)
    assert seen.mean() > 0.7
    write_splats(tmp_path / "none.ply", splats(0))
    for name in ("none.ply", "scene.spz"):
        with pytest.raises(InputError, match=name):
            open_splats(tmp_path / name)
