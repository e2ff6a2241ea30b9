"""Recordings of which the tracker makes several maps, or of which it places too few images."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from fields.geometry.se3 import exp_se3
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.engine import second_tracker
from modp_ti.engine.session import run_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.readers.klt import KltSettings
from modp_ti.inputs.readers.sfm import SfmSettings
from modp_ti.outputs.formats.trajectory import read_trajectory
from modp_ti.outputs.playback.finished_run import finished_metrics
from tests.modp_ti.inputs.klt.conftest import BoxRoom, Walk, box_room  # noqa: F401 (a fixture)
from tests.modp_ti.inputs.klt.conftest import walk as walk_in_the_box
from tests.room import Room, RoomRecording, pinhole, walk

pytestmark = pytest.mark.usefixtures("without_warm_up")


@pytest.fixture
def two_places(tmp_path: Path, box_room: BoxRoom) -> Path:  # noqa: F811
    """A place, nothing, and for longer another place."""
    black = [np.zeros((240, 320, 3), np.uint8)] * 12
    poses = walk_in_the_box(40)
    other = map(box_room.mirrored().image, poses[:30])
    Walk([], [*other, *black, *map(box_room.image, poses)]).written(tmp_path / "images")
    c = box_room.camera
    file = tmp_path / "two_places.yaml"
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


@pytest.mark.slow
def test_the_largest_map_is_the_runs_and_the_other_has_a_folder_in_it(two_places: Path) -> None:
    output = run_scene(load_scene(two_places))
    assert output == two_places.parent / "out"
    frames = {
        folder: json.loads((folder / "metrics.json").read_text())["frames"] for folder in (output, output / "map-2")
    }
    assert list(frames.values()) == [40, 30]
    assert not (output / "map-3").exists() and not (output / "map-2" / "map-2").exists()
    for folder, count in frames.items():
        assert (folder / "splats.ply").is_file() and len(read_trajectory(folder / "trajectory.txt")[0]) == count
    assert finished_metrics(load_scene(two_places)) is not None, "a batch does not repeat it"
    again = load_scene(output / "map-2" / "config.yaml")  # which maps this map alone
    assert getattr(again.tracker, "maps") == 2 and again.output == output / "map-2"  # noqa: B009


CAMERA = pinhole(240, 180)

# A few near views of a walk, and then far ones that come back to it from the other end of the room.
RETURN = [*walk(10, step=0.04), *(walk(61, step=0.05)[i] for i in range(58, 5, -6))]

# Views of a walk, each rolled by 60 degrees against the one before: optical flow finds nothing again.
ROLL = exp_se3([0, 0, 0, 0, 0, np.radians(60)])

ROLLED = [np.linalg.matrix_power(ROLL, i) @ pose for i, pose in enumerate(walk(6, step=0.2))]


def scene(folder: Path, room: Room, poses: Sequence, tracker: str = "{kind: klt, fallback: sfm}") -> SceneConfig:
    (folder / "images").mkdir(exist_ok=True)
    for i, image in enumerate(RoomRecording(room, CAMERA, list(poses)).images):
        cv2.imwrite(str(folder / "images" / f"{i:02d}.png"), image[..., ::-1])
    (folder / "scene.yaml").write_text(f"""
source:  {{path: images, scale: 0.5, intrinsics: {{fx: {CAMERA.fx}}}}}
tracker: {tracker}
output:  out
device:  cpu
mapping: {{optimise: {{steps: 1, last_passes: 0}}}}
refine:  {{steps: 0}}
export:  {{report: false}}
""")
    return load_scene(folder / "scene.yaml")


def mapped(config: SceneConfig) -> tuple[str, int, str]:
    """The tracker in the written settings, the frames of the map, and what was said."""
    console = Console(file=io.StringIO(), width=1000)
    output = run_scene(config, console)
    written = load_scene(output / "config.yaml")
    assert finished_metrics(config) is not None, "a batch does not repeat it"
    frames = json.loads((output / "metrics.json").read_text())["frames"]
    return written.tracker.kind, frames, console.file.getvalue()


@pytest.mark.slow
def test_the_tracker_that_places_more_makes_the_map(
    room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = scene(tmp_path, room, RETURN)
    kind, few, said = mapped(config)
    assert kind == "klt" and 0.8 * len(RETURN) < few < len(RETURN), "the first one is good enough"
    monkeypatch.setattr(second_tracker, "ENOUGH", 1.0)
    kind, more, said = mapped(config)
    assert kind == "sfm" and more > few
    assert f"klt could place only {few} of {len(RETURN)}" in said and f"sfm places {more}" in said


def test_only_a_recording_of_limited_length_has_a_second_choice() -> None:
    assert KltSettings(fallback="sfm").second_choice(50) == SfmSettings()
    assert KltSettings(fallback="sfm").second_choice(100_000) is None
    assert KltSettings().second_choice(50) is None and SfmSettings().second_choice(50) is None


@pytest.mark.slow
def test_images_of_which_the_first_places_none_are_mapped_by_the_second(room: Room, tmp_path: Path) -> None:
    kind, frames, _ = mapped(scene(tmp_path, room, ROLLED))
    assert kind == "sfm" and frames >= 5
    with pytest.raises(InputError, match="klt could place none"):
        run_scene(scene(tmp_path, room, ROLLED, "{kind: klt}"))


def test_where_neither_finds_anything_the_first_one_says_so(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    for i in range(4):
        noise = np.random.default_rng(i).integers(0, 256, (60, 80, 3), dtype=np.uint8)
        cv2.imwrite(str(tmp_path / "images" / f"{i}.png"), noise)
    file = tmp_path / "scene.yaml"
    file.write_text("source: {path: images}\ntracker: {kind: klt, fallback: sfm}\noutput: out\ndevice: cpu\n")
    with pytest.raises(InputError, match="klt could place none of the 4 images"):
        run_scene(load_scene(file))
