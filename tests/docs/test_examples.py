"""The programs of docs/examples: each runs as it stands, and makes what it says."""

from __future__ import annotations

import os
import runpy
from pathlib import Path

import numpy as np
import pytest

from modp_ti.outputs.formats.mesh import open3d
from modp_ti.outputs.formats.splats_ply import read_splats

pytestmark = pytest.mark.slow
EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"


def a_folder(names: dict) -> None:
    assert names["metrics"]["frames"] == 12
    assert names["held_out"]["count"] == 2 and names["held_out"]["psnr"] > 38
    assert (names["output"] / "report.html").is_file()


def own_frames(names: dict) -> None:
    assert names["psnr"] > 38
    shown = [name for name in sorted(os.listdir("out/own_frames")) if not name.startswith(".")]
    assert shown == ["colmap", "frames.json", "splats.ply", "trajectory.txt"]
    assert Path("out/new_view.png").is_file()


def a_loop(names: dict) -> None:
    assert names["errors_before"][-1] > 0.2
    assert names["errors_after"].max() < 0.05
    assert names["psnr_after"] > names["psnr_before"] + 10


def differentiable_rendering(names: dict) -> None:
    assert names["losses"][-1] < 0.05 * names["losses"][0]
    assert names["error_after"] < 0.1 * names["error_before"]


def voxels(names: dict) -> None:
    cells = np.floor(names["kept"] / 0.125)
    assert len(np.unique(cells, axis=0)) == len(cells)  # one point a cell
    assert len(names["new"]) < 0.05 * len(names["kept"])
    assert names["occupied"].all() and names["occupied_finer"].mean() < 0.05
    assert names["near"] > 2 * (len(names["kept_by_distance"]) - names["near"])


def exports(names: dict) -> None:
    assert (read_splats("out/opaque.ply")["opacity_logit"] > 0).all()
    assert len(read_splats("out/splats.ply")["position"]) == len(names["opaque"]) > names["opaque"].sum() > 100
    assert len(open3d().io.read_triangle_mesh("out/mesh.ply").triangles) > 1000
    assert np.median(names["distance"]) < 0.03  # of a depth of four


PROGRAMS = {
    "01_map_a_folder.py": a_folder,
    "02_map_your_own_frames.py": own_frames,
    "03_correct_a_loop.py": a_loop,
    "04_differentiable_rendering.py": differentiable_rendering,
    "05_occupancy_voxels.py": voxels,
    "06_export_the_map.py": exports,
}


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_program_makes_what_it_says(program: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(EXAMPLES))  # as for a program that is started by its path
    PROGRAMS[program](runpy.run_path(str(EXAMPLES / program), run_name="__main__"))


def test_every_program_is_run_and_listed() -> None:
    programs = sorted(path.name for path in EXAMPLES.glob("0*.py"))
    assert programs == list(PROGRAMS)
    page = (EXAMPLES / "index.md").read_text()
    assert all(f"]({name})" in page for name in programs)
