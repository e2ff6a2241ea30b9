"""What a run says of the units of its map."""

from __future__ import annotations

from pathlib import Path

from modp_ti.config.scene_file import scene_from_data
from modp_ti.engine.results import Results
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.outputs.measuring import read_world


def test_a_map_is_in_metres_where_the_poses_of_the_recording_are(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for kind, unit in (("record3d", "m"), ("klt", None), ("sevenscenes", "m"), ("colmap", None)):
        scene = {"source": {"path": str(tmp_path)}, "tracker": {"kind": kind}, "output": str(out)}
        with Results(scene_from_data(scene, "scene"), DeliveredFrames()).writing_map():
            pass
        assert read_world(out).get("unit") == unit, kind
