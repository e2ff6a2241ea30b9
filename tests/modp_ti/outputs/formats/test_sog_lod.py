"""Streamed SOG, read back by a reader written from the published layout."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.map.blocks import extent_of
from modp_ti.outputs.formats.sog_lod import write_sog_lod
from pipelines.blocks.hierarchy import LEVELS, Hierarchy
from tests.modp_ti.outputs.formats.splat_readers import read_sog
from tests.modp_ti.outputs.formats.test_compressed_splats import matched, splats


@pytest.fixture(scope="module")
def hierarchy() -> Hierarchy:
    state = splats(3000, degree=1)
    state["log_scale"] -= 1.5
    return Hierarchy(state)


@pytest.fixture(scope="module")
def folder(hierarchy: Hierarchy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lod")
    write_sog_lod(folder, hierarchy, chunk=1000)
    return folder


def read_chunk(folder: Path, name: str) -> dict[str, NDArray]:
    path = folder / name
    archive = folder / "chunk.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for part in path.parent.iterdir():
            file.write(part, part.name)
    return read_sog(archive)


def leaves(node: dict) -> list[dict]:
    """Leaves of a tree, whose boxes lie in those above."""
    assert ("children" in node) != ("lods" in node)
    if "lods" in node:
        return [node]
    below = [leaf for child in node["children"] for leaf in leaves(child)]
    for side, inside in (("min", np.less_equal), ("max", np.greater_equal)):
        assert all(inside(node["bound"][side], leaf["bound"][side]).all() for leaf in below)
    return below


def test_every_leaf_holds_its_block_at_every_level(hierarchy: Hierarchy, folder: Path) -> None:
    meta = json.loads((folder / "lod-meta.json").read_text())
    assert meta["version"] == 1 and meta["lodLevels"] == LEVELS + 1
    assert meta["counts"] == [len(hierarchy.level(number)) for number in range(LEVELS + 1)]
    assert meta["count"] == sum(meta["counts"]) and meta["counts"][0] == 3000
    chunks = [read_chunk(folder, name) for name in meta["filenames"]]
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
        written = {name: values[level.places] for name, values in level.values.items()}
        back = matched(written, read)
        np.testing.assert_allclose(back["position"], written["position"], atol=4e-4)
        np.testing.assert_allclose(back["sh"][:, 0], written["sh"][:, 0], atol=0.04)
    assert all((count == 1).all() for count in used)
    assert len(chunks) >= 3 + LEVELS


def test_the_same_map_is_written_to_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    state = splats(3000, degree=1)
    state["log_scale"] -= 1.5
    write_sog_lod(tmp_path, Hierarchy(state), chunk=1000)
    files = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file())
    assert len(files) > 8
    for file in files:
        assert (tmp_path / file).read_bytes() == (folder / file).read_bytes(), file
