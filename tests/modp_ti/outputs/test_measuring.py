"""Measured points, lengths and areas, against a room whose geometry is known and against drawn samples."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fields.geometry.se3 import inverse_se3
from modp_ti.commands.app import app
from modp_ti.outputs.measuring import SurfacePoint, area, length, surface_point
from tests.modp_ti.outputs.locating.painted_room import CAMERA, painted, write_run
from tests.room import Room, walk

PIXEL = 1.0 / CAMERA.focal


def rays_of(pixels: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return inverse_se3(T)[:3, 3], CAMERA.unproject(pixels, np.ones(len(pixels))) @ T[:3, :3]


@pytest.fixture(scope="module")
def places(room: Room) -> tuple[np.ndarray, np.ndarray]:
    """A pose, and pixels (N, 2) around which the room is smooth."""
    T = walk(1)[0]
    pixels = np.random.default_rng(3).uniform([8, 8], [CAMERA.width - 8, CAMERA.height - 8], (300, 2))
    around = [room.depth(CAMERA, T, pixels + offset) for offset in ([4, 0], [-4, 0], [0, 4], [0, -4], [0, 0])]
    pixels = pixels[np.ptp(np.log(around), axis=0) < 0.04]
    assert len(pixels) > 100
    return T, pixels


def test_points_lie_on_the_surfaces_of_a_room_whatever_floats_before_them(room: Room, places):
    T, pixels = places
    eye, rays = rays_of(pixels, T)
    truth = eye + room.cast(eye, rays)[0][:, None] * rays
    state = painted(room, [T])
    # A veil of a third of the light, halfway to each point.
    veil = {name: values[: len(pixels)].copy() for name, values in state.items()}
    veil["position"] = ((eye + truth) / 2).astype(np.float32)
    veil["log_scale"][:] = np.log(0.01)
    veil["opacity_logit"][:] = np.log(0.33 / 0.67)
    for gaussians in (state, {name: np.concatenate([values, veil[name]]) for name, values in state.items()}):
        found = [surface_point(gaussians, eye, ray, PIXEL) for ray in rays]
        off = np.linalg.norm([point.xyz for point in found if point] - truth, axis=1)
        assert np.quantile(off, 0.95) < 0.01  # of 2 to 4 m


def test_where_nothing_is_there_is_no_surface(room: Room, places):
    T, pixels = places
    state = painted(room, [T])
    eye, rays = rays_of(pixels[:5], T)
    assert all(surface_point(state, eye, -ray, PIXEL) is None for ray in rays)
    thin = state | {"opacity_logit": state["opacity_logit"] - 6.0}
    assert all(surface_point(thin, eye, ray, PIXEL) is None for ray in rays)


def test_deviations_are_those_of_drawn_samples():
    rng = np.random.default_rng(5)
    xyz = np.array([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
    roots = 0.003 * rng.normal(size=(4, 3, 3))
    points = [SurfacePoint(at, root @ root.T) for at, root in zip(xyz, roots, strict=True)]
    samples = xyz + np.einsum("nij,snj->sni", roots, rng.normal(size=(20_000, 4, 3)))
    for measure, exact in ((length, 5.0), (area, 2.0)):
        value, deviation = measure(points)
        drawn = [measure([SurfacePoint(at, np.zeros((3, 3))) for at in sample])[0] for sample in samples[:4000]]
        assert value == pytest.approx(exact)
        assert deviation == pytest.approx(np.std(drawn), rel=0.1)


def test_the_command_measures_between_pixels_of_frames(room: Room, tmp_path: Path):
    poses = write_run(room, tmp_path / "out")
    texts, truth = [], []
    for frame, pixel in ((0, (40.0, 60.0)), (3, (190.0, 70.0)), (3, (120.0, 150.0))):
        eye, (ray,) = rays_of(np.array([pixel]), poses[frame])
        truth.append(eye + room.cast(eye, ray[None])[0][0] * ray)
        texts.append(f"{pixel[0]},{pixel[1]}@{frame}")
    result = CliRunner().invoke(app, ["measure", str(tmp_path / "out"), *texts, "--json"])
    assert result.exit_code == 0, result.output
    data = json.loads(result.stdout)
    exact = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert exact > 2.0
    assert data["length"]["value"] == pytest.approx(exact, abs=0.01)
    assert data["area"]["value"] == pytest.approx(0.5 * np.linalg.norm(np.cross(*np.diff(truth, axis=0))), abs=0.02)
    assert [point["xyz"] for point in data["points"]] == [pytest.approx(at, abs=0.01) for at in truth]
    for wrong in ("10,10", "10,10@99", "1000,10@0", "a,b@0"):
        result = CliRunner().invoke(app, ["measure", str(tmp_path / "out"), wrong])
        assert result.exit_code == 2 and result.stderr.count("\n") == 1 and wrong in result.stderr
