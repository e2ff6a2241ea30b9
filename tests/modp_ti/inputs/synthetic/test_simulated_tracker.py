"""The demo sequence: pictures, depth, poses and points belong together, and the noise is what it says."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_settings import SyntheticSettings
from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.synthetic import SyntheticTracker, TrackerNoise, open_synthetic, simulated_tracker
from modp_ti.inputs.synthetic.renderer import RoomRenderer

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def frames(perfect: SyntheticTracker) -> list[TrackedFrame]:
    return list(perfect)


def transform(T: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    return points @ T[:3, :3].T + T[:3, 3]


def warp_error(tracker: SyntheticTracker, i: int, j: int, T_j: NDArray[np.float64]) -> NDArray[np.float64]:
    """|frame i - frame j seen through the depth of i| where j sees the same surface."""
    camera, depth = tracker.camera, tracker.depth(i)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
    world = transform(np.linalg.inv(tracker.ground_truth()[i]), camera.unproject(pixels, depth.ravel()))
    there = transform(T_j, world)
    uv = camera.project(there).astype(np.float32).reshape(*depth.shape, 2)
    seen_depth = cv2.remap(tracker.depth(j), uv[..., 0] - 0.5, uv[..., 1] - 0.5, cv2.INTER_NEAREST)
    seen = cv2.remap(tracker.image(j), uv[..., 0] - 0.5, uv[..., 1] - 0.5, cv2.INTER_LINEAR)
    same = np.abs(seen_depth - there[:, 2].reshape(depth.shape)) < 0.02 * seen_depth
    edges = cv2.dilate(depth, np.ones((3, 3))) > 1.03 * cv2.erode(depth, np.ones((3, 3)))
    assert (same & ~edges).mean() > 0.3
    return np.abs(seen - tracker.image(i)).mean(axis=2)[same & ~edges]


@pytest.mark.parametrize(("i", "j"), [(0, 2), (10, 12), (14, 11), (26, 23)])
def test_frames_warp_into_each_other_by_depth_and_pose(perfect: SyntheticTracker, i: int, j: int) -> None:
    truth = perfect.ground_truth()
    right = warp_error(perfect, i, j, truth[j])
    assert np.median(right) < 0.012
    wrong = truth[j].copy()
    wrong[0, 3] += 0.03
    assert np.median(warp_error(perfect, i, j, wrong)) > 1.5 * np.median(right), "the pictures have no texture"


def test_without_noise_points_and_poses_are_exact(perfect: SyntheticTracker, frames: list[TrackedFrame]) -> None:
    places: dict[int, NDArray[np.float64]] = {}
    for frame, truth in zip(frames, perfect.ground_truth(), strict=True):
        np.testing.assert_allclose(frame.T_camera_world, truth, atol=1e-12)
        camera_points = transform(truth, frame.points.xyz)
        np.testing.assert_allclose(frame.camera.project(camera_points), frame.points.pixels, atol=1e-9)
        column, row = np.floor(frame.points.pixels).astype(int).T
        np.testing.assert_allclose(perfect.depth(frame.index)[row, column], camera_points[:, 2], rtol=0.011)
        assert len(np.unique(frame.points.ids)) == len(frame.points)
        for number, xyz in zip(frame.points.ids, frame.points.xyz, strict=True):
            np.testing.assert_array_equal(places.setdefault(int(number), xyz), xyz)


def test_points_are_many_and_stay_in_view(frames: list[TrackedFrame]) -> None:
    counts = [len(frame.points) for frame in frames]
    assert 75 <= min(counts) and max(counts) <= 150
    for before, after in pairwise(frames):
        shared = np.isin(after.points.ids, before.points.ids).mean()
        assert shared > 0.5


def test_points_lie_on_texture(frames: list[TrackedFrame]) -> None:
    """Hardly one of them is in the dullest quarter of its picture."""
    for frame in frames[::9]:
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        deviation = np.sqrt(np.maximum(cv2.blur(grey**2, (5, 5)) - cv2.blur(grey, (5, 5)) ** 2, 0))
        column, row = np.floor(frame.points.pixels).astype(int).T
        assert (deviation[row, column] < np.quantile(deviation, 0.25)).mean() < 0.15


Make = Callable[..., SyntheticTracker]


@pytest.fixture
def make(room: RoomRenderer) -> Make:
    """Small trackers in the shared room."""

    def build(**options: object) -> SyntheticTracker:
        return SyntheticTracker(**{"width": 96, "height": 72, "frames": 24, "points": 80, "room": room, **options})

    return build


def test_the_noise_is_as_large_as_it_says(make: Make) -> None:
    noise = TrackerNoise(pixel=0.5, depth=0.02, translation=0.004, rotation=0.2, drift=0.0)
    noisy = make(frames=400, noise=noise)
    relative = np.array(
        [T @ np.linalg.inv(truth) for T, truth in zip(noisy._tracked, noisy.ground_truth(), strict=True)]
    )
    angles = Rotation.from_matrix(relative[:, :3, :3]).as_rotvec(degrees=True)
    np.testing.assert_allclose(angles.std(axis=0), 0.2, rtol=0.15)
    np.testing.assert_allclose(relative[:, :3, 3].std(axis=0), 0.004 * 2.5, rtol=0.15)

    size = {"width": 160, "height": 120, "points": 200, "frames": 8}
    short, exact = make(noise=noise, **size), make(noise=TrackerNoise.none(), **size)
    first_noisy, first_exact = next(iter(short)), next(iter(exact))
    ids, a, b = np.intersect1d(first_noisy.points.ids, first_exact.points.ids, return_indices=True)
    assert len(ids) > 30
    off = first_noisy.points.pixels[a] - first_exact.points.pixels[b]
    np.testing.assert_allclose(off.std(), 0.5, rtol=0.25)
    z_noisy = transform(first_noisy.T_camera_world, first_noisy.points.xyz[a])[:, 2]
    z_exact = transform(first_exact.T_camera_world, first_exact.points.xyz[b])[:, 2]
    np.testing.assert_allclose(np.log(z_noisy / z_exact).std(), 0.02, rtol=0.3)


def test_pose_errors_drift_and_points_go_with_them(make: Make) -> None:
    """Neighbouring frames err alike, and a tracker's points fit its own poses better than the true ones."""
    noise = TrackerNoise(pixel=0.0, depth=0.0, translation=0.02, rotation=1.0, drift=10.0)
    noisy = make(noise=noise)
    relative = [T @ np.linalg.inv(truth) for T, truth in zip(noisy._tracked, noisy.ground_truth(), strict=True)]
    angles = np.array([Rotation.from_matrix(r[:3, :3]).as_rotvec(degrees=True) for r in relative])
    assert np.abs(np.diff(angles, axis=0)).max() < 0.5 * np.abs(angles).max()
    frame = next(iter(noisy))
    own = frame.camera.project(transform(frame.T_camera_world, frame.points.xyz)) - frame.points.pixels
    true = frame.camera.project(transform(noisy.ground_truth()[0], frame.points.xyz)) - frame.points.pixels
    assert np.abs(own).max() < 1e-6
    assert np.abs(true).max() > 0.3


def test_the_same_seed_gives_the_same_frames_and_another_one_other_noise(make: Make) -> None:
    first, again, other = make(frames=6), make(frames=6), make(frames=6, seed=1)
    for a, b, c in zip(first, again, other, strict=True):
        assert a.image.tobytes() == b.image.tobytes() == c.image.tobytes()
        assert a.points.xyz.tobytes() == b.points.xyz.tobytes()
        assert a.points.pixels.tobytes() == b.points.pixels.tobytes()
        assert a.T_camera_world.tobytes() == b.T_camera_world.tobytes()
        assert not np.array_equal(a.T_camera_world, c.T_camera_world)
    twice = [frame.points.pixels.tobytes() for frame in first]
    assert twice == [frame.points.pixels.tobytes() for frame in first]


def test_the_scale_of_the_map_is_arbitrary(make: Make) -> None:
    metres, others = make(frames=3), make(frames=3, metres_per_unit=0.25)
    for a, b in zip(metres, others, strict=True):
        np.testing.assert_allclose(b.points.xyz, 4 * a.points.xyz)
        np.testing.assert_allclose(b.T_camera_world[:3, 3], 4 * a.T_camera_world[:3, 3])
        np.testing.assert_array_equal(b.T_camera_world[:3, :3], a.T_camera_world[:3, :3])
        np.testing.assert_array_equal(b.points.pixels, a.points.pixels)
    np.testing.assert_array_equal(others.ground_truth(), metres.ground_truth())


def test_pictures_are_well_exposed_and_the_camera_keeps_its_distance(
    perfect: SyntheticTracker, frames: list[TrackedFrame]
) -> None:
    for frame in frames:
        assert frame.image.dtype == np.float32
        assert 0 <= frame.image.min() and frame.image.max() <= 1
        assert 0.2 < frame.image.mean() < 0.6
        assert (frame.image >= 0.999).all(axis=2).mean() < 0.05
        assert perfect.depth(frame.index).min() > 0.7


def test_the_camera_moves_smoothly_with_parallax(make: Make) -> None:
    centres = np.array([-T[:3, :3].T @ T[:3, 3] for T in make(frames=56).ground_truth()])
    ways = np.array([T[2, :3] for T in make(frames=56).ground_truth()])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    turns = np.degrees(np.arccos(np.clip((ways[:-1] * ways[1:]).sum(axis=1), -1, 1)))
    assert steps.max() < 0.12 and turns.max() < 4
    assert np.linalg.norm(centres[-1] - centres[0]) > 1.5
    assert np.degrees(np.arccos(ways[0] @ ways[-1])) > 60


def test_open_synthetic_follows_the_scene(room: RoomRenderer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulated_tracker, "RoomRenderer", lambda: room)
    tracker = SyntheticSettings()
    opened = open_synthetic(SourceSettings(scale=0.25, holdout=3, fps=5, start=4, stop=12, step=2), tracker)
    assert isinstance(opened, Tracker) and opened.frame_count == 4
    assert "demo room" in opened.notes[0]
    got = list(opened)
    assert [frame.index for frame in got] == [0, 1, 2, 3]
    assert [frame.held_out for frame in got] == [True, False, False, True]
    assert [frame.timestamp for frame in got] == pytest.approx([0.8, 1.2, 1.6, 2.0])
    assert got[0].image.shape == (60, 80, 3)
    whole = open_synthetic(SourceSettings(), tracker)
    assert (whole.camera.width, whole.camera.height, len(whole)) == (320, 240, 56)
    np.testing.assert_array_equal(opened.ground_truth(), whole.ground_truth()[4:12:2])


@pytest.mark.parametrize(
    ("settings", "part"),
    [({"scale": 0.01}, "use 0.14 or more"), ({"start": 900}, "lies behind the 56 frames")],
)
def test_settings_that_leave_nothing_are_refused(settings: dict[str, float], part: str) -> None:
    source = SimpleNamespace(**{**SourceSettings().model_dump(), **settings})
    with pytest.raises(InputError, match=part):
        open_synthetic(source, SyntheticSettings())
