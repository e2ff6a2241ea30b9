"""The numbers and pictures behind the report, computed another way."""

from __future__ import annotations

import base64

import cv2
import matplotlib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modp_ti.outputs.evaluation import FrameScore
from modp_ti.outputs.report.from_above import floor_plan, plan_of
from modp_ti.outputs.report.page import FULL_SCALE, Album, picked
from modp_ti.outputs.report.plots import binned, frame_rate, shifts_and_turns
from modp_ti.outputs.report.record import WINDOW, FrameNote, RunRecord, retention
from pipelines.pipeline import FrameReport
from tests.modp_ti.outputs.report.made_up_run import cameras


def score(index: int, psnr: float, held_out: bool = True) -> FrameScore:
    return FrameScore(index, f"f{index}", held_out, "online", psnr, 0.9, None)


def test_the_worst_the_median_and_the_best_are_picked() -> None:
    psnr = np.random.default_rng(1).permutation(np.arange(20.0, 41.0))  # 21 frames; the median has 30 dB
    chosen = picked([score(i, p) for i, p in enumerate(psnr)])
    assert [s.psnr for s, _ in chosen[:3]] == [20.0, 21.0, 22.0]
    assert len(chosen) == 7
    assert {word: s.psnr for s, word in chosen if word} == {"worst": 20.0, "median": 30.0, "best": 40.0}
    assert [s.psnr for s, _ in chosen] == sorted(s.psnr for s, _ in chosen)


@pytest.mark.parametrize("count", range(9))
def test_of_few_frames_each_is_shown_once(count: int) -> None:
    chosen = picked([score(i, 20.0 + i) for i in range(count)])
    assert [s.index for s, _ in chosen] == list(range(count))[: len(chosen)] or count > 7
    assert len({s.index for s, _ in chosen}) == len(chosen) == min(count, 7)
    if count > 2:
        assert chosen[0][1] == "worst" and chosen[-1] == (score(count - 1, 19.0 + count), "best")


def test_held_out_frames_are_read_from_the_written_pairs(tmp_path) -> None:
    rng = np.random.default_rng(2)
    image, other = (cv2.resize(rng.random((2, 2, 3)).astype(np.float32), (1600, 1200)) for _ in range(2))
    render = 0.8 * image + 0.2 * other
    pair = np.round(np.hstack([image, render])[..., ::-1] * 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "000004.png"), pair)
    album = Album.of([False] * 4 + [True])
    album.keep(1, image, render)
    assert album.kept == {}, "pictures of held-out frames are on the disk already"
    (shown,) = album.comparisons([score(4, 25.0), score(1, 30.0, held_out=False)], tmp_path)
    assert shown.score.index == 4

    def decoded(uri: str) -> np.ndarray:
        data = np.frombuffer(base64.b64decode(uri.removeprefix("data:image/jpeg;base64,")), np.uint8)
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1].astype(float)
        assert decoded.shape == (360, 480, 3)
        return decoded

    image, render = (cv2.resize(one, (480, 360), interpolation=cv2.INTER_AREA) for one in (image, render))

    for uri, expected in ((shown.frame, image), (shown.render, render)):
        assert np.abs(decoded(uri) - 255 * expected).mean() < 3
    difference = np.clip(np.abs(image - render).mean(axis=2) / FULL_SCALE, 0, 1)
    expected = matplotlib.colormaps["inferno"](difference)[..., :3] * 255
    assert np.abs(decoded(shown.error) - expected).mean() < 8


def test_where_none_is_held_out_a_few_frames_are_kept() -> None:
    album = Album.of([False] * 100)
    for i in range(100):
        album.keep(i, np.full((8, 8, 3), i / 100, np.float32), np.zeros((8, 8, 3), np.float32))
    assert len(album.kept) == 7 and {0, 99} <= set(album.kept)
    shown = album.comparisons([score(i, 30.0 - i / 10, held_out=False) for i in range(100)], None)
    assert [s.score.index for s in shown] == sorted(album.kept, reverse=True)
    assert set(Album.of([False]).wanted) == {0}


@pytest.mark.parametrize("count", [1, 2, 8])
def test_the_frame_rate_is_the_inverse_of_the_mean_duration_of_the_last_frames(count: int) -> None:
    durations = [0.25, 3.0, 1.0, 0.25, 0.25, 2.0, 0.5, 0.125][:count]
    done = np.cumsum(durations)
    rate, window = frame_rate([FrameNote(i, False, True, float(t), 0, None) for i, t in enumerate(done)], 3), 3
    window = min(window, count)  # of fewer frames, the rate of all
    expected = [1 / np.mean(durations[i + 1 - window : i + 1]) for i in range(window - 1, count)]
    np.testing.assert_allclose(rate, [*[np.nan] * (window - 1), *expected])


def test_few_values_are_left_alone_and_many_become_means_of_neighbours() -> None:
    x, y = np.arange(1.0, 5.0), np.array([4.0, np.nan, 2.0, 7.0])
    np.testing.assert_array_equal(binned(x, y, 10), ([1, 3, 4], [4, 2, 7]))
    x = np.arange(1000.0)
    at, mean = binned(x, 2 * x + 1, 10)
    np.testing.assert_allclose(at, np.arange(10) * 100 + 49.5)
    np.testing.assert_allclose(mean, 2 * at + 1)


def test_shifts_and_turns_are_those_of_the_cameras() -> None:
    rng = np.random.default_rng(3)
    before, after, shifts, turns = [], [], [], []
    for degrees in (0.0, 1e-5, 0.02, 3.0, 90.0, 180.0):
        R, turn = Rotation.random(random_state=rng), Rotation.from_rotvec([0, np.radians(degrees), 0])
        centre, shift = rng.normal(size=3), rng.normal(size=3)
        for poses, rotation, place in ((before, R, centre), (after, turn * R, centre + shift)):
            T = np.eye(4)
            T[:3, :3] = rotation.as_matrix()
            T[:3, 3] = -T[:3, :3] @ place
            poses.append(T)
        shifts.append(np.linalg.norm(shift))
        turns.append(degrees)
    found = shifts_and_turns(before, after)
    np.testing.assert_allclose(found[0], shifts, rtol=1e-9)
    np.testing.assert_allclose(found[1], turns, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("rotvec", [(0, 0, 0), (0.3, -1.2, 2.0)])
def test_up_is_where_the_cameras_were_held_up_and_distances_on_the_ground_are_kept(rotvec) -> None:
    R, world = Rotation.from_rotvec(rotvec).as_matrix(), np.eye(4)
    world[:3, :3] = R.T
    plan = plan_of([T @ world for T in cameras(20)])
    np.testing.assert_allclose(plan[2], R @ [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(np.cross(plan[0], plan[1]), plan[2], atol=1e-12)
    points = np.random.default_rng(0).normal(size=(30, 3))
    page = (points @ R.T) @ plan[:2].T
    ground = np.linalg.norm(points[:, None, :2] - points[None, :, :2], axis=2)
    np.testing.assert_allclose(np.linalg.norm(page[:, None] - page[None], axis=2), ground, atol=1e-12)


def test_the_first_camera_looks_up_the_page_and_the_way_runs_across_it() -> None:
    poses = cameras(20)
    for i, T in enumerate(poses):  # the circle drawn out to an ellipse along the world's y
        centre = -T[:3, :3].T @ T[:3, 3] * [1, 4, 1]
        poses[i] = np.vstack([np.hstack([T[:3, :3], -(T[:3, :3] @ centre)[:, None]]), [0, 0, 0, 1]])
    right, ahead, _ = plan_of(poses)
    assert poses[0][2, :3] @ ahead >= -1e-12
    assert abs(right[1]) == pytest.approx(1.0)


@pytest.mark.parametrize("heights", [[0], [0, 0, 0], [0, 1, 2, 3]])
def test_cameras_that_stand_still_or_move_straight_up_have_a_plan_too(heights: list[int]) -> None:
    poses = np.tile(np.eye(4), (len(heights), 1, 1))
    poses[:, 1, 3] = heights
    axes = plan_of(list(poses))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(axes[2], [0, -1, 0], atol=1e-9)


def test_the_floor_is_what_is_opaque_and_below_the_cameras_the_highest_on_top() -> None:
    poses = cameras(8, height=1.5)
    plan = plan_of(poses)
    position = np.array([[0, 0, 1.0], [1, 0, 0.0], [0, 1, 2.0], [2, 2, 0.5]], np.float32)
    logit = np.array([3.0, 3.0, 3.0, -3.0], np.float32)  # the last one is transparent, the third is the ceiling
    sh = np.zeros((4, 4, 3), np.float32)
    sh[0, 0], sh[1, 0] = [1.0, 0, 0], [0, 9.0, -9.0]
    centres = np.array([-T[:3, :3].T @ T[:3, 3] for T in poses])
    places, colours = floor_plan(plan, {"position": position, "opacity_logit": logit, "sh": sh}, centres)
    np.testing.assert_allclose(places, position[[1, 0]].astype(float) @ plan.T, atol=1e-6)
    np.testing.assert_allclose(colours, [[0.5, 1, 0], [0.5 + 0.5 / np.sqrt(np.pi), 0.5, 0.5]], atol=1e-6)


def test_frames_are_noted_with_the_time_since_the_first_began() -> None:
    times = iter([1000.0, 1000.5, 1002.0, 1002.25])
    record = RunRecord(clock=lambda: next(times))
    record.begin()
    record.frame(0, FrameReport(0, True, 1, 250, 18.5), 19.5)
    record.frame(1, None)
    record.frame(2, FrameReport(2, False, 1, 260, None, 7), lag=0.25, waiting=2)
    assert record.frames == [
        FrameNote(0, False, True, 0.5, 250, 18.5, 19.5),
        FrameNote(1, True, False, 2.0, 250, None),  # held out: the map is as it was
        FrameNote(2, False, False, 2.25, 260, None, lag=0.25, waiting=2, steps=7),
    ]


def notes(mapped: list[float | None]) -> list[FrameNote]:
    return [FrameNote(i, False, psnr is not None, float(i), 10, psnr, psnr) for i, psnr in enumerate(mapped)]


def scores(psnr: list[float], stage: str = "online") -> list[FrameScore]:
    return [FrameScore(i, f"f{i}", False, stage, value, 0.9, None) for i, value in enumerate(psnr)]


def test_the_change_is_that_of_keyframes_in_every_version() -> None:
    of = retention(notes([20.0, None, 22.0]), scores([21.0, 0.0, 21.0]) + scores([24.0, 0.0, 25.0], "refined"))
    assert of == {"online": {"mean": 0.0, "worst": 0.0}, "refined": {"mean": 3.5, "worst": 3.5}}


def test_the_worst_is_the_mean_of_a_stretch_and_not_of_a_keyframe() -> None:
    count = 3 * WINDOW
    final = [30.0] * count
    for i in range(WINDOW + 5, 2 * WINDOW):  # three quarters of a window lose 2 dB
        final[i] = 28.0
    of = retention(notes([30.0] * count), scores(final))
    assert of is not None
    assert of["online"]["worst"] == pytest.approx(-2.0 * (WINDOW - 5) / WINDOW)
    assert of["online"]["mean"] == pytest.approx(-2.0 * (WINDOW - 5) / count)


def test_without_mapped_keyframes_there_is_none() -> None:
    assert retention(notes([None, None]), scores([20.0, 21.0], "offline")) is None
