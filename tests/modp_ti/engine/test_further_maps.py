"""Each map that the tracker made of a recording is mapped in a run of its own."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.engine.session import run_scene
from modp_ti.outputs.formats.trajectory import read_trajectory
from modp_ti.outputs.playback.finished_run import finished_metrics
from tests.modp_ti.inputs.klt.conftest import BoxRoom, Walk, box_room, walk  # noqa: F401 (a fixture)

pytestmark = pytest.mark.slow


@pytest.fixture
def scene(tmp_path: Path, box_room: BoxRoom) -> Path:  # noqa: F811
    """A place, nothing, and for longer another place."""
    other = replace(box_room, textures={wall: sheet[::-1].copy() for wall, sheet in box_room.textures.items()})
    black = [np.zeros((240, 320, 3), np.uint8)] * 12
    poses = walk(60)
    Walk([], [*map(other.image, poses[:45]), *black, *map(box_room.image, poses)]).written(tmp_path / "images")
    c = box_room.camera
    file = tmp_path / "scene.yaml"
    file.write_text(f"""
source:  {{path: images, scale: 0.25, intrinsics: {{fx: {c.fx}, fy: {c.fy}, cx: {c.cx}, cy: {c.cy}}}}}
tracker: {{kind: klt, maps: all}}
output:  out
device:  cpu
mapping: {{optimise: {{steps: 1, last_passes: 0}}}}
refine:  {{steps: 0}}
export:  {{report: false}}
""")
    return file


def test_the_largest_map_is_the_runs_and_the_other_has_a_folder_in_it(scene: Path) -> None:
    output = run_scene(load_scene(scene))
    assert output == scene.parent / "out"
    frames = {
        folder: json.loads((folder / "metrics.json").read_text())["frames"] for folder in (output, output / "map-2")
    }
    assert list(frames.values()) == [60, 45]
    assert not (output / "map-3").exists() and not (output / "map-2" / "map-2").exists()
    for folder, count in frames.items():
        assert (folder / "splats.ply").is_file() and len(read_trajectory(folder / "trajectory.txt")[0]) == count
    assert finished_metrics(load_scene(scene)) is not None, "a batch does not repeat it"
    again = load_scene(output / "map-2" / "config.yaml")  # which maps this map alone
    assert getattr(again.tracker, "maps") == 2 and again.output == output / "map-2"  # noqa: B009
