"""Adam steps of poses on the GPU are those of the host, and so are its safeguards."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from fields.runtime.backend import initialise
from pipelines.companions.exposure import ExposureRefinement
from pipelines.optimise.cameras import make_cameras
from pipelines.optimise.poses import PoseRefinement
from pipelines.render.renderer import Renderer
from pipelines.settings import ExposureSettings
from tests.pipelines.wall import frame

PLAIN = [(g, 0.5) for g in np.random.default_rng(0).normal(size=(8, 6))]
BROKEN = [(np.array([0.1, 0.0, np.nan, 0.0, 0.0, 0.0]), 0.5), (np.full(6, np.inf), 0.5)]
AWAY = [(np.ones(6), 500.0)]  # px, of images 64 wide


def stepped(steps: list[tuple[NDArray, float]]) -> dict[str, NDArray]:
    renderer = Renderer(GaussianField(0, max_gaussians=1 << 12), 64, 48)
    view = KeyframeStore(levels=2).append(frame(1))
    poses = PoseRefinement()
    cameras = make_cameras(renderer, poses, ExposureRefinement(ExposureSettings()))
    small = view.at_level(1)
    cameras.render(small, small.image(0), 0.1, exact=True)  # steps are in pixels of the full size all the same
    for gradient, rate in steps:
        if type(cameras).__name__ == "Cameras":
            poses.step(view, gradient, rate)
            continue
        renderer.projected.seen[None] = 1
        renderer.projected.tangent.grad[0] = gradient.astype(np.float32)
        cameras.step_pose(view, rate, is_last=True)
    cameras.settle()
    moments = np.concatenate(poses.moments.of(view.index))
    return {"pose": view.correction, "moments": moments, "caught": np.array(poses.safeguards.camera_steps)}


def test_steps_are_those_of_the_host(on_both: Callable) -> None:
    cpu, gpu = on_both(lambda: stepped(PLAIN))
    assert np.abs(cpu["pose"] - np.eye(4)).max() > 0.01
    for name, value in cpu.items():
        np.testing.assert_allclose(gpu[name], value, rtol=1e-4, atol=1e-5, err_msg=name)


def test_what_is_not_finite_or_runs_away_is_undone_and_counted(on_both: Callable) -> None:
    for steps, remembered in ((PLAIN + BROKEN, len(PLAIN)), (PLAIN + AWAY, 0)):
        cpu, gpu = on_both(lambda steps=steps: stepped(steps))
        assert gpu["caught"] == cpu["caught"] == len(steps) - len(PLAIN)
        np.testing.assert_allclose(gpu["pose"], cpu["pose"], atol=1e-5)
        np.testing.assert_allclose(gpu["moments"], cpu["moments"], rtol=1e-4, atol=1e-5)
        assert cpu["moments"][-1] == remembered


def test_a_step_of_the_exposure_leaves_the_pose(gpu: str) -> None:
    initialise(gpu)
    renderer = Renderer(GaussianField(0, max_gaussians=1 << 12), 64, 48)
    view = KeyframeStore().append(frame(1))
    view.exposure = np.eye(3, 4)
    cameras = make_cameras(renderer, PoseRefinement(), ExposureRefinement(ExposureSettings()))
    pose = view.T_camera_world
    cameras.render(view, view.image(0), 0.1, exact=True)
    renderer.backward()
    cameras.step_exposure(view, 1.0, is_last=True)
    cameras.settle()
    assert view.T_camera_world is pose
    assert cameras.exposure.moments.steps == {view.index: 1}
