"""The blocks of docs/api.md, run one after the other as they stand."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from modp_ti.outputs.formats.splats_ply import read_splats
from tests.patience import PATIENCE
from tests.pipelines.wall import frame

pytestmark = pytest.mark.slow

PAGE = Path(__file__).resolve().parents[2] / "docs" / "api.md"
BLOCKS = re.findall(r"^## ([^\n]+)\n.*?```python\n(.*?)```", PAGE.read_text(), re.DOTALL | re.MULTILINE)


def my_tracker() -> Iterator[tuple]:
    """Four frames before a wall."""
    for i in range(4):
        wall = frame(i)
        image = np.round(wall.image * 255).astype(np.uint8)
        yield image, wall.T_camera_world, wall.points.xyz, wall.points.pixels


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    """The names that each section's block leaves behind. In one folder: the second reads what the first has saved."""
    folder = tmp_path_factory.mktemp("api")
    left = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for section, code in BLOCKS:
            left[section] = {"my_tracker": my_tracker, "folder": folder}
            exec(compile(code, f"{PAGE.name}: {section}", "exec"), left[section])
    return left


def test_every_block_is_run(ran: dict[str, dict]) -> None:
    assert len(ran) == PAGE.read_text().count("```python") == 3


def test_the_loop_leaves_a_map_of_the_wall(ran: dict[str, dict]) -> None:
    names = ran["Map the frames of your own loop"]
    assert names["report"].keyframes == 4 and names["report"].gaussians > 300
    render, truth = np.clip(names["picture"].colour, 0, 1), frame(3).image
    assert -10 * np.log10(((render - truth) ** 2).mean()) > 24
    assert sorted(p.name for p in (names["folder"] / "out" / "room").iterdir()) == [
        *(".modp-ti", "colmap", "frames.json", "splats.ply", "trajectory.txt"),
    ]
    assert len(read_splats(names["folder"] / "out" / "room" / "splats.ply")["position"]) > 300


def test_the_torch_loop_finds_colours_and_pose_again(ran: dict[str, dict]) -> None:
    names = ran["The renderer as a PyTorch function"]
    assert names["losses"][-1] < 0.1 * names["losses"][0]
    # Where the camera looks, that is: before a wall it may stand a little nearer or to the side.
    assert names["xi"].detach()[3:].abs().max() < 0.01


def test_the_voxels_thin_the_points(ran: dict[str, dict]) -> None:
    names = ran["The voxels alone"]
    cells = np.floor(names["kept"] / 0.25)
    assert len(np.unique(cells, axis=0)) == len(cells) == len(np.unique(np.floor(names["points"] / 0.25), axis=0))
    assert names["finer"].sum() < len(names["kept"]) + 500


TRACKER = """
from collections.abc import Iterator
import numpy as np
from numpy.typing import NDArray
Arrays = tuple[NDArray[np.uint8], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
def my_tracker() -> Iterator[Arrays]: ...
"""


def test_every_block_passes_a_type_checker(tmp_path: Path) -> None:
    pytest.importorskip("basedpyright")
    for number, (_, code) in enumerate(BLOCKS):
        (tmp_path / f"block_{number}.py").write_text(TRACKER + code)
    checked = subprocess.run(
        [sys.executable, "-m", "basedpyright", "--level", "error", "--pythonpath", sys.executable, str(tmp_path)],
        cwd=PAGE.parents[1],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert checked.returncode == 0, checked.stdout
