"""The exported page: one file that holds the map upright, with a flight along the trajectory, and loads nothing."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fields.geometry.camera import PinholeCamera
from modp_ti.outputs.formats.run_files import FramesRecord
from modp_ti.outputs.formats.sog import sog_bytes
from modp_ti.outputs.playback.camera_paths import looking_at
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.splat_page.page import DEPTH, level, moved, viewer_settings, write_splat_page
from tests.modp_ti.outputs.formats.test_splats import clustered, splats
from tests.pipelines.reference import sh_basis

UP = np.array([0.0, -1.0, 0.0])
DEPTH_HERE = 2.0


def walk(tilt: NDArray[np.float64], pitch: float = 0.6) -> NDArray[np.float64]:
    """Cameras without roll that look down by `pitch` in all directions, in a world that is rotated by `tilt`."""
    poses = []
    for angle in np.linspace(0, 5, 12):
        ahead = np.array([np.sin(angle), np.tan(pitch), np.cos(angle)])
        eye = 0.5 * np.array([np.cos(angle), 0.2 * np.sin(3 * angle), np.sin(angle)])
        poses.append(looking_at(tilt @ eye, tilt @ (eye + ahead), tilt @ UP))
    return np.stack(poses)


def finished(poses: NDArray[np.float64], times: NDArray[np.float64]) -> FinishedRun:
    camera = PinholeCamera(100.0, 100.0, 80.0, 60.0, 160, 120)
    record = FramesRecord(near=0.01, scene_depth=DEPTH_HERE, keyframes=[0], held_out=[])
    return FinishedRun(Path("run"), [str(i) for i in range(len(poses))], times, poses, [camera] * len(poses), record)


@pytest.mark.parametrize("angles", [(0, 0, 0), (35, 0, 20), (-80, 30, 5), (180, 0, 0), (0, 0, 180)])
def test_down_is_where_cameras_without_roll_say_however_the_world_is_turned(angles: tuple[float, ...]) -> None:
    tilt = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    found = level(walk(tilt), DEPTH_HERE)
    np.testing.assert_allclose(found.R @ found.R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found.R) == pytest.approx(1)
    np.testing.assert_allclose(found.R @ tilt @ UP, UP, atol=3e-3)
    assert found.scale == DEPTH / DEPTH_HERE


def test_a_camera_that_only_goes_ahead_is_taken_to_look_ahead() -> None:
    """Its x axes are parallel, and leave the pitch open."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = -np.arange(5)
    np.testing.assert_allclose(level(poses, 1.0).R, np.eye(3), atol=1e-9)


def test_a_moved_map_has_its_shapes_and_colours_turned() -> None:
    state, R, scale = splats(50, degree=3), Rotation.random(random_state=3).as_matrix(), 2.5
    there = moved(state, R, scale)

    def covariances(s: dict) -> NDArray:
        axes = Rotation.from_quat(s["quaternion"], scalar_first=True).as_matrix() * np.exp(s["log_scale"])[:, None]
        return axes @ axes.transpose(0, 2, 1)

    np.testing.assert_allclose(covariances(there), scale**2 * R @ covariances(state) @ R.T, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(there["position"], scale * state["position"] @ R.T, rtol=1e-6, atol=1e-6)
    d = np.random.default_rng(0).normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    seen, seen_there = (np.einsum("nk,nkc->nc", sh_basis(3, way), s["sh"]) for way, s in ((d, state), (d @ R.T, there)))
    np.testing.assert_allclose(seen_there, seen, atol=1e-5)


def test_the_flight_follows_the_trajectory_at_its_pace() -> None:
    tilt = Rotation.from_euler("xyz", (20, 0, 10), degrees=True).as_matrix()
    poses, moments = walk(tilt), 2.0 * np.arange(12)
    upright = level(poses, DEPTH_HERE)
    settings = viewer_settings(finished(poses, moments), upright)
    track = settings["animTracks"][0]
    assert track["duration"] == 22.0
    times, values = track["keyframes"]["times"], track["keyframes"]["values"]
    assert times[0] == 0 and times[-1] == track["duration"] * track["frameRate"] and (np.diff(times) > 0).all()
    eyes, targets = (np.reshape(values[name], (-1, 3)) for name in ("position", "target"))
    assert len(eyes) == len(targets) == len(values["fov"]) == len(times)
    # Cameras 0.5 units from the axis, smoothed; all look down by 0.6 rad from the horizon, y being up in the viewer.
    ahead = targets - eyes
    np.testing.assert_allclose(np.linalg.norm(ahead, axis=1), DEPTH, rtol=1e-3)
    np.testing.assert_allclose(np.arcsin(-ahead[:, 1] / DEPTH), 0.6, atol=0.25)
    assert np.linalg.norm(eyes[:, [0, 2]], axis=1).max() < 0.5 * upright.scale
    assert values["fov"][0] == pytest.approx(np.degrees(2 * np.arctan(0.8)), abs=1e-3)
    start = {name: values[name][:3] for name in ("position", "target")} | {"fov": values["fov"][0]}
    assert settings["cameras"][0]["initial"] == start
    # Along panoramas, it looks where their first faces do.
    faces = [Rotation.from_euler("y", 90 * number, degrees=True).as_matrix() for number in range(4)]
    turned = np.repeat(poses, 4, axis=0)
    turned[:, :3] = np.concatenate([faces] * 12) @ turned[:, :3]
    assert viewer_settings(finished(turned, np.repeat(moments, 4)), upright) == settings


@pytest.mark.parametrize(("span", "duration"), [(0.5, 4.0), (3600.0, 90.0)])
def test_a_flight_is_neither_too_short_nor_too_long(span: float, duration: float) -> None:
    run = finished(walk(np.eye(3)), np.linspace(0, span, 12))
    track = viewer_settings(run, level(run.poses, DEPTH_HERE))["animTracks"][0]
    assert track["duration"] == duration
    assert len(track["keyframes"]["times"]) <= 1000  # the viewer's limit


def test_a_single_frame_has_a_flight_that_stays() -> None:
    run = finished(walk(np.eye(3))[:1], np.zeros(1))
    values = viewer_settings(run, level(run.poses, DEPTH_HERE))["animTracks"][0]["keyframes"]["values"]
    assert np.ptp(np.reshape(values["position"], (-1, 3)), axis=0).max() == 0


# ---- the file ----------------------------------------------------------------------------------------------------

NAME = "</title><script>alert('x')</script> & more"
ALPHABET = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%&()*+-;,=>?@^_`{|}~"


class Elements(HTMLParser):
    """The page's elements by id or name, and its attributes."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.at = ""
        self.texts: dict[str, str] = {}
        self.attributes: list[tuple[str, str, str]] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.at = dict(attrs).get("id") or tag
        self.attributes += [(tag, key, value or "") for key, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        self.at = ""

    def handle_data(self, data: str) -> None:
        self.texts[self.at] = self.texts.get(self.at, "") + data


def test_the_page_holds_the_map_and_the_viewer_and_may_load_nothing(tmp_path: Path) -> None:
    state = clustered(4000, degree=1)
    write_splat_page(tmp_path / "map.html", NAME, {"note": "</script>"}, state)
    page = Elements((tmp_path / "map.html").read_text("utf-8"))
    content, text = bytearray(), page.texts["map"]
    for i in range(0, len(text), 5):
        word = 0
        for character in text[i : i + 5]:
            word = 85 * word + ALPHABET.index(character)
        content += word.to_bytes(4, "big")
    sog = sog_bytes(state)
    assert content[: len(sog)] == sog and not any(content[len(sog) :])
    assert json.loads(page.texts["settings"]) == {"note": "</script>"}
    assert page.texts["title"].strip() == NAME
    for tag, key, value in page.attributes:
        assert key not in ("src", "srcset", "action") and (key != "href" or value == "data:,"), (tag, key, value)
    policy = next(v for _, key, v in page.attributes if key == "content" and v.startswith("default-src"))
    assert policy.startswith("default-src 'none';") and not re.search(r"https?:|\*|'self'", policy)
    for part in ("style", "script"):  # the licence asks for it
        assert "SuperSplat Viewer" in page.texts[part]
        assert "Permission is hereby granted, free of charge" in page.texts[part]
    assert (tmp_path / "map.html").stat().st_size < 2_200_000 + 20 * 4000
