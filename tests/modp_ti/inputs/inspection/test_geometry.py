"""Conventions are told apart by matched features and by points, on cameras and points that are known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3
from modp_ti.inputs.inspection.conventions import CONVENTIONS, STATED, Convention
from modp_ti.inputs.inspection.findings import Severity, verdict
from modp_ti.inputs.inspection.geometry import epipolar_score, judge_geometry, measure_geometry
from modp_ti.inputs.inspection.survey import MatchedPair, survey

CAMERA = PinholeCamera(300.0, 305.0, 161.0, 118.0, 320, 240)
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# T_body_camera: the camera looks along x of the body, whose z is up.
BODY = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def poses(count: int = 6) -> list[np.ndarray]:
    result = []
    for i in range(count):
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(np.array([0.02 * i, -0.05 * i, 0.03 * i]))[0]
        T[:3, 3] = (0.2 * i, 0.05 * i, 0.1 * i)
        result.append(T)
    return result


def world(count: int = 400) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.c_[rng.uniform(-1.0, 1.0, (count, 2)), rng.uniform(4, 7, count)]


def pixels(T: np.ndarray, noise: float) -> np.ndarray:
    rng = np.random.default_rng(4)
    exact = CAMERA.project(world() @ T[:3, :3].T + T[:3, 3])
    return exact + rng.normal(0, noise, exact.shape)


def wrongly(convention: Convention, T: np.ndarray) -> np.ndarray:
    """The pose that has to be read after the convention to be T."""
    T = OPENGL @ T if convention.opengl else T
    T = BODY @ T if convention.body else T
    if convention.wxyz:
        x, y, z, w = Rotation.from_matrix(T[:3, :3].T).as_quat()
        centre = np.linalg.inv(T)[:3, 3]
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_quat([w, x, y, z]).as_matrix(), centre
        T = np.linalg.inv(T)
    return np.linalg.inv(T) if convention.inverse else T


def wrong_camera(c: Convention) -> PinholeCamera:
    f, k = c.intrinsics * c.focal, c.intrinsics
    return PinholeCamera(CAMERA.fx / f, CAMERA.fy / f, CAMERA.cx / k, CAMERA.cy / k, 320, 240)


# Poses of other images are told by the images alone.
OF_ONE_IMAGE = [convention for convention in CONVENTIONS if not convention.shift]


@pytest.mark.parametrize("convention", OF_ONE_IMAGE, ids=lambda c: c.name)
def test_exact_matches_fit_the_convention_that_the_numbers_are_of_and_no_other(convention: Convention) -> None:
    T = poses()
    pairs = [MatchedPair(a, a + 2, pixels(T[a], 0), pixels(T[a + 2], 0), 1.0) for a in range(4)]
    given = [wrongly(convention, each) for each in T]
    scores = {c: epipolar_score(pairs, [wrong_camera(convention)] * 6, given, c) for c in OF_ONE_IMAGE}
    assert scores[convention].share == 1.0
    assert scores[convention].error < 1e-6
    assert scores[convention].matches == 4 * 400
    for other, score in scores.items():
        assert other is convention or score.error > 0.3


def test_the_error_is_the_distance_that_the_matches_are_off() -> None:
    # A camera that moves along x: epipolar lines are rows, and half of a pixel across is shared by both images.
    left, right = np.eye(4), np.eye(4)
    right[0, 3] = -1.0
    square = PinholeCamera(300.0, 300.0, 160.0, 120.0, 320, 240)
    a = square.project(world())
    b = square.project(world() + right[:3, 3]) + np.array([3.0, 0.5])
    score = epipolar_score([MatchedPair(0, 1, a, b, 1.0)], [square] * 2, [left, right], STATED)
    assert score.error == pytest.approx(0.5 / np.sqrt(2), rel=1e-6)


def test_points_behind_the_cameras_do_not_fit() -> None:
    # Turned round by its mirror image the epipolar geometry is the same; only before and behind differ.
    T = poses()
    pairs = [MatchedPair(0, 3, pixels(T[0], 0), pixels(T[3], 0), 1.0)]
    mirrored = [np.block([[each[:3, :3], -each[:3, 3:]], [np.zeros((1, 3)), 1]]) for each in T]
    score = epipolar_score(pairs, [CAMERA] * 6, mirrored, STATED)
    assert score.error < 1e-6
    assert score.share < 0.05


def frames(convention: Convention, noise: float, count: int = 6) -> list[TrackedFrame]:
    """Frames without any detail, whose points alone can tell."""
    blank = np.full((240, 320, 3), 0.5, dtype=np.float32)
    return [
        TrackedFrame(
            i,
            i / 30,
            f"{i}",
            blank,
            wrong_camera(convention),
            wrongly(convention, T),
            SparsePoints(world(), pixels(T, noise), np.arange(400)),
        )
        for i, T in enumerate(poses(count))
    ]


@pytest.mark.parametrize("convention", OF_ONE_IMAGE, ids=lambda c: c.name)
def test_where_no_feature_matches_the_points_decide(convention: Convention) -> None:
    geometry = measure_geometry(survey(frames(convention, 0.5), None, lambda _: None))
    assert geometry.epipolar[STATED].matches == 0
    assert geometry.points == 6 * 400
    findings = list(judge_geometry(geometry))
    if convention is STATED:
        assert findings == []
        return
    (found,) = findings
    assert (found.code, found.severity) == (convention.name.lower().replace(" ", "_"), Severity.UNUSABLE)
    assert verdict(findings) == ("unusable", 2)


@pytest.mark.parametrize("shift", [1, -1])
def test_poses_of_the_next_image_are_told_from_others(shift: int) -> None:
    rng = np.random.default_rng(6)
    T = [exp_se3(rng.normal(0, 0.15, 6)) @ each for each in poses(9)]
    pairs = [MatchedPair(a, a + 2, pixels(T[a], 0), pixels(T[a + 2], 0), 1.0) for a in range(1, 6)]
    given = [T[min(max(i - shift, 0), 8)] for i in range(9)]
    seen = survey(
        [replace(f, T_camera_world=G) for f, G in zip(frames(STATED, 0.5, 9), given, strict=True)], 9, lambda _: None
    )
    seen.pairs = pairs
    (found,) = judge_geometry(measure_geometry(seen))
    assert found.severity is Severity.UNUSABLE
    assert found.code == {1: "poses_one_image_late", -1: "poses_one_image_early"}[shift]


def test_pixels_that_were_computed_from_the_poses_prove_nothing() -> None:
    geometry = measure_geometry(survey(frames(STATED, 0.0), 6, lambda _: None))
    assert geometry.points == 0
    (found,) = judge_geometry(geometry)
    assert (found.code, found.severity) == ("poses_not_judged", Severity.NOTE)
