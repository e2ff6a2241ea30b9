"""Offline 3DGS on the wall of test_mapping.py."""

from __future__ import annotations

import numpy as np
import pytest

from fields.map.keyframes import KeyframeStore
from pipelines.offline import OfflineMapper, Schedule, scene_extent
from pipelines.settings import OfflineSettings
from tests.pipelines.test_online import CAMERA, frame

pytestmark = pytest.mark.slow

STEPS = 600
HELD_OUT = 3
# The cameras move little before a wide wall: the published sizes, which follow the cameras, would prune all of it.
SETTINGS = OfflineSettings(steps=STEPS, clone_size=0.1, prune_size=2.0, reset_every=9000, max_gaussians=1 << 14)


def store(scale: float = 1.0) -> KeyframeStore:
    keyframes = KeyframeStore()
    for i in range(7):
        keyframes.append(frame(i, scale=scale))
    return keyframes


def mapper(settings: OfflineSettings = SETTINGS) -> OfflineMapper:
    result = OfflineMapper(settings, 64, 48, seed=1)
    for i in range(7):
        if i != HELD_OUT:
            result.process(frame(i))
    return result


def psnr(m: OfflineMapper, i: int) -> float:
    f = frame(i)
    near = m.settings.near * m.keyframes.scene_depth
    colour = np.clip(m.renderer.render(CAMERA, f.T_camera_world, near).colour, 0, 1)
    return -10 * np.log10(((colour - f.image) ** 2).mean())


# ---- schedule ------------------------------------------------------------------------------------------------


def rounds(schedule: Schedule) -> list[int]:
    return [step for step in range(1, schedule.steps + 1) if schedule.adapts_at(step)]


def resets(schedule: Schedule) -> list[int]:
    return [step for step in range(1, schedule.steps + 1) if schedule.resets_at(step)]


def test_the_published_run_has_the_published_steps() -> None:
    schedule = Schedule.of(OfflineSettings())
    assert rounds(schedule) == list(range(600, 15_000, 100))
    assert resets(schedule) == [3000, 6000, 9000, 12_000]
    assert [schedule.sh_degree(step) for step in (1, 999, 1000, 1999, 2000, 3000, 30_000)] == [0, 0, 1, 1, 2, 3, 3]


def test_a_shorter_run_keeps_its_shares_but_not_its_waits() -> None:
    schedule = Schedule.of(OfflineSettings(steps=6000))
    assert rounds(schedule) == list(range(600, 3000, 100))
    assert resets(schedule) == [1500]  # not after 600 steps each
    assert schedule.sh_degree(600) == 3
    schedule = Schedule.of(OfflineSettings(steps=1500))
    assert rounds(schedule) == [200, 300, 400, 500, 600, 700]
    assert resets(schedule) == []
    assert rounds(Schedule.of(OfflineSettings(steps=120))) == [20, 30, 40, 50]
    assert Schedule.of(OfflineSettings(steps=1)).sh_degree(1) <= 3


# ---- a map ---------------------------------------------------------------------------------------------------


def test_the_extent_is_that_of_the_cameras_and_never_nothing() -> None:
    centres = np.array([np.linalg.inv(view.T_camera_world)[:3, 3] for view in store()])
    radius = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    assert scene_extent(store()) == pytest.approx(1.1 * radius)
    assert scene_extent(store(100.0)) == pytest.approx(100 * scene_extent(store()))
    turning = KeyframeStore()
    turning.append(frame(0))
    assert scene_extent(turning) == pytest.approx(0.01 * turning.scene_depth)
    with pytest.raises(ValueError):
        scene_extent(KeyframeStore())


@pytest.fixture(scope="module")
def mapped(taichi_on_the_cpu: None) -> tuple[OfflineMapper, dict[str, float]]:
    """The finished map, and figures of it before the first step."""
    m = OfflineMapper(SETTINGS, 64, 48, seed=1)
    m.compile()
    for i in range(7):
        if i != HELD_OUT:
            m.process(frame(i))
    m.initialise()
    before = {"psnr": psnr(m, HELD_OUT), "gaussians": len(m.gaussians)}
    m.optimise(lambda step, gaussians, _: before.update(steps=step, last=gaussians))
    return m, before


def test_a_map_of_all_frames_shows_the_frame_that_it_never_saw(mapped: tuple[OfflineMapper, dict[str, float]]) -> None:
    m, before = mapped
    assert psnr(m, HELD_OUT) > before["psnr"] + 10
    assert psnr(m, HELD_OUT) > 25


def test_it_begins_with_the_tracked_points_and_grows(mapped: tuple[OfflineMapper, dict[str, float]]) -> None:
    m, before = mapped
    assert before["gaussians"] == 6 * 120
    assert len(m.gaussians) > 1.3 * before["gaussians"]
    assert m.renderer.view_renders == before["steps"] == STEPS
    assert before["last"] == len(m.gaussians)
    assert np.abs(m.gaussians.to_numpy()["sh"][:, 9:]).max() > 0  # the third band was reached
