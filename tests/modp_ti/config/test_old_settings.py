"""Settings that 0.1.0 wrote, with one flat list of keys for all trackers, give the same run today."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from modp_ti.config.old_settings import without_leftovers
from modp_ti.config.scene_file import load_scene, scene_from_data
from modp_ti.files.errors import InputError

# The `tracker` section as 0.1.0 wrote it into every config.yaml and snapshot.
FLAT = """\
  path: null
  points: null
  adjust: null
  max_points: 2000
  max_difference: 0.02
  time_offset: 0.0
  camera: camera-rgb
  max_inv_dist_std: 0.005
  max_dist_std: 0.05
  address: null
  patience: 120.0
  exposure_change: 0.0
  drift: 0.0
  correction: false
"""
# Keys of the `synthetic` kind of 0.1.0, which no kind has any more.
GONE = ("exposure_change", "drift", "correction")
# Of each kind, what may have been set, with a value that is not the default.
SET = {
    "colmap": {"path": "/m"},
    "transforms": {"path": "/m"},
    "klt": {},
    "tum": {"path": "/m", "points": "/p", "max_points": 99, "max_difference": 0.1, "time_offset": 2.0},
    "orbslam3": {"path": "/m", "adjust": True, "max_difference": 0.1, "time_offset": 2.0},
    "stella_vslam": {"path": "/m", "max_difference": 0.1, "time_offset": 2.0},
    "aria": {"path": "/m", "camera": "left", "max_inv_dist_std": 0.1, "max_dist_std": 0.2, "max_points": 99},
    "modp": {"path": "/m"},
    "replica": {"path": "/m", "points": "/p", "max_points": 99},
    "sevenscenes": {"path": "/m", "adjust": False},
    "socket": {"path": "/m", "patience": 3.0},
}


def written(kind: str, changes: dict) -> dict:
    """The settings as plain data."""
    tracker = {"kind": kind, **yaml.safe_load(FLAT), **changes}
    return {"source": {"path": "/images"}, "tracker": tracker, "output": "/out"}


@pytest.mark.parametrize("kind", SET)
def test_a_resolved_configuration_of_0_1_0_still_runs(kind, tmp_path):
    data = written(kind, SET[kind])
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(data))
    for config in (load_scene(tmp_path / "config.yaml"), scene_from_data(data, "snapshot.npz")):
        tracker = config.tracker.model_dump(mode="json")
        assert {key: tracker[key] for key in SET[kind]} == SET[kind]
        assert {key: tracker[key] for key in tracker if key not in SET[kind] and key in data["tracker"]} == {
            key: value for key, value in data["tracker"].items() if key in tracker and key not in SET[kind]
        }, "the rest is at the defaults of 0.1.0"


@pytest.mark.parametrize("key", [line.split(":")[0].strip() for line in FLAT.splitlines()])
def test_only_what_says_nothing_is_dropped(key):
    data = written("klt", {key: "other"})
    owner = "" if key in GONE else r": it is for tracker\.kind"
    with pytest.raises(InputError, match=rf"unknown key `tracker\.{key}`{owner}"):
        scene_from_data(data, "config.yaml")


def test_a_key_that_never_was_one_is_refused_even_where_it_is_empty():
    with pytest.raises(InputError, match=r"unknown key `tracker\.magic`"):
        scene_from_data(written("colmap", {"magic": None}), "config.yaml")


@pytest.mark.parametrize("tracker", [None, 7, {}, {"path": None}, {"kind": "orb", "drift": 0.0}, {"kind": ["colmap"]}])
def test_without_a_kind_nothing_is_dropped(tracker):
    assert without_leftovers({"tracker": tracker, "seed": 3}) == {"tracker": tracker, "seed": 3}
    assert without_leftovers({}) == {}


def test_settings_are_not_changed_in_place():
    data = written("colmap", {})
    without_leftovers(data)
    assert len(data["tracker"]) == 15


def test_scenes_in_the_documentation_of_0_1_0_are_valid(tmp_path):
    for number, tracker in enumerate(("{kind: colmap, path: sparse/0}", "{kind: transforms}")):
        file: Path = tmp_path / f"{number}.yaml"
        file.write_text(f"source: {{path: images, scale: 0.5, holdout: 8}}\ntracker: {tracker}\noutput: out\n")
        assert load_scene(file).tracker.kind in tracker


@pytest.mark.parametrize("tracker", [{"kind": "synthetic"}, written("synthetic", {"drift": 0.05})["tracker"]])
def test_the_rendered_demo_of_0_1_0_is_refused_with_what_replaces_it(tracker, tmp_path):
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump({"tracker": tracker, "output": "out"}))
    with pytest.raises(InputError, match=r"demo/room\.mp4") as caught:
        load_scene(tmp_path / "scene.yaml")
    assert "\n" not in str(caught.value)


def test_the_prior_of_exposures_that_0_2_0_wrote_has_no_effect() -> None:
    data = {"tracker": {"kind": "socket"}, "output": "out", "mapping": {"exposure": {"enabled": True, "prior": 0.001}}}
    assert scene_from_data(data, "config.yaml").mapping.exposure.enabled is True
    assert data["mapping"]["exposure"]["prior"] == 0.001
