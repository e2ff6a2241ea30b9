"""The place of a map by GPS: simulated walks with known similarities, and geodesy against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from modp_ti.files.errors import InputError
from modp_ti.inputs.positions import Positions
from modp_ti.outputs.formats.run_files import FramesRecord
from modp_ti.outputs.locating.georeference import axes_at, ecef, georeference
from modp_ti.outputs.playback.finished_run import CAMERA, FinishedRun
from modp_ti.outputs.splat_page.page import Y

ORIGIN = np.array([47.37, -8.54, 430.0])
RATE = 18.0  # of GoPro's fixes [1/s]


def walk(seconds: float = 60.0) -> NDArray[np.float64]:
    """A walk of a metre a second along a street that bends: east, down, north [m]."""
    d = np.arange(0.0, seconds, 1.0 / RATE)
    return np.stack([d, 0.03 * np.sin(5.0 * d), 4.0 * np.sin(d / 12.0)], axis=1)


def degrees(local: NDArray[np.float64]) -> NDArray[np.float64]:
    """Geodetic coordinates of local metres, to first order by finite differences: within millimetres on a walk."""
    step = np.diag([1e-5, 1e-5, 1.0])
    J = np.stack([(ecef(ORIGIN + row) - ecef(ORIGIN - row)) @ axes_at(ORIGIN) / 2.0 for row in step], axis=1)
    return ORIGIN + np.linalg.solve(J, local.T).T @ step


def run_of(places: NDArray[np.float64], S: NDArray[np.float64], s: float) -> FinishedRun:
    """A run whose cameras went along places [m], in a world that is turned by S (3, 3) and in units of s metres."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3] = S.T
    poses[:, :3, 3] = -((places / s + 2.0) @ S.T) @ S
    names = [f"{k}.jpg" for k in range(len(places))]
    record = FramesRecord(near=0.01, scene_depth=1.0, keyframes=[0], held_out=[])
    return FinishedRun(Path("out"), names, np.arange(len(places)) / RATE, poses, [CAMERA] * len(places), record)


@pytest.mark.parametrize("seed", range(10))
def test_the_scale_of_a_walk_of_60_m_is_right_to_a_percent_with_errors_of_2_m(seed: int) -> None:
    rng, true = np.random.default_rng(seed), walk()
    S, s = Rotation.random(random_state=seed).as_matrix(), float(rng.uniform(0.1, 9.0))
    noisy = true + rng.normal(0.0, 2.0, true.shape)
    wrong = rng.random(len(true)) < 0.1
    noisy[wrong] += rng.normal(0.0, 30.0, (wrong.sum(), 3))
    run = run_of(true, S, s)
    found = georeference(run, Positions(degrees(noisy), run.timestamps), S @ [0.0, 1.0, 0.0])
    assert found.s == pytest.approx(s, rel=0.01)
    assert abs(found.s / s - 1.0) < 4.0 * found.deviation < 0.03
    assert found.error == pytest.approx(2.0, rel=0.25)
    np.testing.assert_allclose(found.R @ S, np.eye(3), atol=0.02)


@pytest.mark.parametrize("down_known", [True, False])
def test_a_walk_around_a_house_gives_all_of_the_similarity_by_the_names_of_photographs(down_known: bool) -> None:
    a = np.linspace(0.0, 2.0 * np.pi, 40)
    true = np.stack([25.0 * np.cos(a), 0.2 * np.sin(9.0 * a), 15.0 * np.sin(a)], axis=1)
    S = Rotation.random(random_state=1).as_matrix()
    run = run_of(true, S, 3.0)
    chosen = slice(3, 35)
    positions = Positions(degrees(true)[chosen], names=run.names[chosen])
    found = georeference(run, positions, S @ [0.0, 1.0, 0.0] if down_known else None)
    centres = -np.einsum("nij,ni->nj", run.poses[:, :3, :3], run.poses[:, :3, 3])
    there = (ecef(found.origin) - ecef(ORIGIN)) @ axes_at(ORIGIN)
    np.testing.assert_allclose(found.s * centres @ found.R.T + found.t + there, true, atol=0.01)


def test_positions_that_do_not_tell_the_scale_are_refused() -> None:
    rng, S = np.random.default_rng(4), np.eye(3)
    standing = rng.normal(0.0, 0.05, (600, 3))
    run = run_of(standing, S, 1.0)
    noisy = Positions(degrees(standing + rng.normal(0.0, 2.0, standing.shape)), run.timestamps)
    elsewhen = Positions(degrees(standing), run.timestamps + 1e4)
    few = Positions(degrees(walk()[:3]), run.timestamps[:3])
    for positions in (noisy, elsewhen, few):
        with pytest.raises(InputError):
            georeference(run, positions, Y)


def test_earth_centred_coordinates_are_those_of_the_ellipsoid() -> None:
    rng = np.random.default_rng(6)
    at = np.column_stack([rng.uniform(-89, 89, 50), rng.uniform(-180, 180, 50), np.zeros(50)])
    xyz, polar = ecef(at), 6_356_752.3142
    on = (xyz**2 / np.array([6_378_137.0, 6_378_137.0, polar]) ** 2).sum(axis=1)
    np.testing.assert_allclose(on, 1.0, atol=1e-12)
    for place, here in zip(at, xyz, strict=True):
        axes = axes_at(place)
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
        above = ecef(place + np.array([0.0, 0.0, 100.0])) - here
        np.testing.assert_allclose(axes.T @ above, [0.0, -100.0, 0.0], atol=1e-6)
        north = ecef(place + np.array([1e-4, 0.0, 0.0])) - here
        np.testing.assert_allclose(axes.T @ north / np.linalg.norm(north), [0.0, 0.0, 1.0], atol=1e-5)
