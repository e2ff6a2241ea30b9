"""The error by depth, angle and place of frames whose error and depth are known, and needles that are placed."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.outputs.evaluation import explained_detail
from modp_ti.outputs.report.where_wrong import COLUMNS, ROWS, Bin, ErrorSurvey, Motion, Needles
from pipelines.render.renderer import RenderedView

WIDTH, HEIGHT = 120, 80
CAMERA = PinholeCamera(60.0, 60.0, 60.0, 40.0, WIDTH, HEIGHT)  # 90 degrees wide
SIDEWAYS, AHEAD = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
SOLID = np.ones((HEIGHT, WIDTH), np.float32)
# Depths of the rows, in the middle of bins: near below, far above.
RAMP = np.repeat(np.array([300.0, 70.0, 30.0, 3.0], np.float32), HEIGHT // 4)[:, None] * SOLID


def pose(centre: NDArray[np.float64], R: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3] = np.eye(3) if R is None else R
    T[:3, 3] = -T[:3, :3] @ centre
    return T


def frame_of(image: NDArray, index: int = 0, views: int = 1) -> TrackedFrame:
    return TrackedFrame(index, 0.0, "", image.astype(np.float32), CAMERA, np.eye(4), views=views)


def noise(seed: int) -> NDArray[np.float32]:
    """An image of whole 8-bit values."""
    return (np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3)) / 255.0).astype(np.float32)


def surveyed(render: NDArray, image: NDArray, depth: NDArray, motion: Motion, opacity: NDArray = SOLID) -> ErrorSurvey:
    survey = ErrorSurvey(held_out=True)
    survey.add(frame_of(image), RenderedView(render, depth * opacity, opacity), motion)
    return survey


def by_label(bins: list[Bin]) -> dict[str, Bin]:
    return {of.label: of for of in bins}


def test_an_error_on_what_is_near_is_found_there_and_nowhere_else() -> None:
    image, step = noise(1), 0.1
    near = RAMP == 3.0
    render = np.where(near[..., None], noise(2), image)
    survey = surveyed(render, image, step * RAMP, Motion(SIDEWAYS, step))
    bins = by_label(survey.by_depth())
    assert list(bins) == ["2 to 5", "20 to 50", "50 to 100", "200 to 500"]
    assert [of.pixels for of in bins.values()] == pytest.approx([0.25] * 4)
    assert [of.error for of in bins.values()] == pytest.approx([1.0, 0.0, 0.0, 0.0])
    assert bins["2 to 5"].absolute == pytest.approx(np.abs(image - render)[near].mean(), rel=1e-5)
    assert bins["200 to 500"].detail == pytest.approx(1.0, abs=1e-9)
    assert bins["2 to 5"].words in survey.in_words()


def test_the_unit_of_depth_is_the_step_so_that_scale_does_not_matter() -> None:
    image, render = noise(1), noise(2)
    totals = [surveyed(render, image, s * RAMP, Motion(SIDEWAYS, s)).totals for s in (1e-3, 1.0, 1e4)]
    np.testing.assert_array_equal(totals[0], totals[1])
    np.testing.assert_array_equal(totals[2], totals[1])


def test_shares_sum_to_one_and_the_whole_has_the_scores_of_the_frame() -> None:
    image, render = noise(1), 0.6 * noise(1) + 0.4 * noise(2)
    opacity = np.where(np.arange(WIDTH) < 30, 0.2, 0.9).astype(np.float32) * SOLID
    survey = surveyed(render, image, RAMP, Motion(np.array([0.6, 0.0, 0.8]), 1.0), opacity)
    depths, angles = survey.by_depth(), survey.by_angle()
    for bins in (depths, angles):
        assert sum(of.pixels for of in bins) == pytest.approx(1.0)
        assert sum(of.error for of in bins) == pytest.approx(1.0)
        assert sum(of.pixels * of.absolute for of in bins) == pytest.approx(np.abs(image - render).mean(), rel=1e-5)
    assert depths[-1].pixels == pytest.approx(0.25), "what is transparent has no depth"
    error, detail = survey.by_place()
    assert error.shape == detail.shape == (ROWS, COLUMNS)
    assert np.square(error).mean() == pytest.approx(np.square(image - render).mean(), rel=1e-5)
    _, _, _, band, lost = survey.totals.sum(axis=(1, 2, 3, 4))
    expected = explained_detail(render, image, np.ones((HEIGHT, WIDTH), bool))
    assert 1 - lost / band == pytest.approx(expected, abs=1e-5)


def test_frames_add_up_and_masked_pixels_do_not_count() -> None:
    image, motion = noise(1), Motion(AHEAD, 1.0)
    survey = surveyed(noise(2), image, RAMP, motion)
    survey.add(frame_of(image), RenderedView(noise(3), RAMP, SOLID), motion)
    both = surveyed(noise(2), image, RAMP, motion).totals + surveyed(noise(3), image, RAMP, motion).totals
    np.testing.assert_allclose(survey.totals, both, rtol=1e-12)
    masked, survey = dataclasses.replace(frame_of(image), mask=RAMP > 10.0), ErrorSurvey(held_out=False)
    survey.add(masked, RenderedView(noise(2), RAMP, SOLID), motion)
    assert [(of.label, of.pixels) for of in survey.by_depth()] == [
        (label, pytest.approx(1 / 3)) for label in ("20 to 50", "50 to 100", "200 to 500")
    ]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_angle_is_that_between_the_ray_and_the_line_of_motion(sign: float) -> None:
    image, render = noise(1), noise(2)
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5 - 60) / 60, (np.arange(HEIGHT) + 0.5 - 40) / 60)
    rays = np.stack([x, y, np.ones_like(x)], axis=2)
    for direction in (SIDEWAYS, AHEAD):
        cosine = np.abs(rays @ direction) / np.linalg.norm(rays, axis=2)
        counts = np.histogram(np.degrees(np.arccos(cosine)), [0, 5, 10, 20, 30, 45, 60, 90.001])[0]
        bins = surveyed(render, image, RAMP, Motion(sign * direction, 1.0)).by_angle()
        assert [of.pixels for of in bins] == pytest.approx(counts[counts > 0] / counts.sum())
    # A narrow picture looks along the motion, or across it.
    narrow = PinholeCamera(2000.0, 2000.0, 60.0, 40.0, WIDTH, HEIGHT)
    for direction, label in ((SIDEWAYS, "60° to 90°"), (AHEAD, "0° to 5°")):
        survey, frame = ErrorSurvey(held_out=False), dataclasses.replace(frame_of(image), camera=narrow)
        survey.add(frame, RenderedView(render, RAMP, SOLID), Motion(sign * direction, 1.0))
        assert [of.label for of in survey.by_angle()] == [label]


def test_an_error_in_one_corner_is_drawn_there() -> None:
    image = noise(1)
    render = image.copy()
    render[: HEIGHT // ROWS, -WIDTH // COLUMNS :] = 0.0
    error, detail = surveyed(render, image, RAMP, Motion(AHEAD, 1.0)).by_place()
    assert error[0, -1] > 0.3 and detail[0, -1] < 0.2
    error[0, -1] = 0.0
    assert not error.any()


@pytest.mark.parametrize(
    ("index", "around"), [(0, (0, 4)), (2, (0, 4)), (4, (0, 9)), (6, (4, 9)), (9, (4, 9)), (11, (4, 9))]
)
def test_the_motion_is_that_from_the_keyframe_before_to_the_one_after(index: int, around: tuple[int, int]) -> None:
    rng = np.random.default_rng(4)
    centres = rng.normal(size=(12, 3))
    turns = Rotation.random(12, random_state=5).as_matrix()
    poses = [pose(centre, R) for centre, R in zip(centres, turns, strict=True)]
    way = centres[around[1]] - centres[around[0]]
    motion = Motion.at(poses, [0, 4, 9], frame_of(noise(0), index))
    assert motion is not None
    np.testing.assert_allclose(motion.direction, turns[index] @ way / np.linalg.norm(way), atol=1e-12)
    passed = [k for k in (0, 4, 9) if around[0] <= k <= around[1]]
    steps = [np.linalg.norm(centres[a] - centres[b]) for a, b in pairwise(passed)]
    assert motion.step == pytest.approx(np.mean(steps))


def test_views_of_one_time_each_have_their_own_motion_and_a_camera_that_stands_has_none() -> None:
    poses = [pose(np.array([float(i // 2), 0.0, 5.0 * (i % 2)])) for i in range(8)]
    motion = Motion.at(poses, [0, 1, 4, 5], frame_of(noise(0), 3, views=2))
    assert motion is not None and motion.step == pytest.approx(2.0)
    np.testing.assert_allclose(motion.direction, SIDEWAYS, atol=1e-12)
    assert Motion.at(poses, [0], frame_of(noise(0))) is None
    assert Motion.at([np.eye(4)] * 8, [0, 4], frame_of(noise(0), 2)) is None


def test_needles_are_found_and_those_that_point_to_a_view_are_told_apart() -> None:
    view = (CAMERA, np.eye(4))
    position = np.array([[0, 0, 4], [1, 0, 4], [0, 1, 4], [0, 0, -4], [0, 0, 4]], np.float32)
    along = Rotation.align_vectors([position[1]], [[0, 0, 1]])[0]
    across = Rotation.from_euler("y", 90, degrees=True)
    turns = [Rotation.identity(), along, across, Rotation.identity(), Rotation.identity()]
    quaternion = 3.0 * np.array([turn.as_quat()[[3, 0, 1, 2]] for turn in turns], np.float32)
    log_scale = np.log(np.array([[1, 1, 20]] * 4 + [[1, 20, 20]], np.float32))
    gaussians = {"position": position, "quaternion": quaternion, "log_scale": log_scale}
    needles = Needles.of(gaussians, [view])
    # The disc is no needle; the needle behind the camera is not seen.
    assert needles.share == pytest.approx(4 / 5) and needles.along == pytest.approx(2 / 3)
    assert Needles.of({name: values[:0] for name, values in gaussians.items()}, [view]) == Needles(0.0, None)
