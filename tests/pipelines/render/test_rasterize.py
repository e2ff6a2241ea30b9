"""`rasterize` against the plain renderer, against finite differences, and as the renderer of a training loop."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import conv2d

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import exp_se3, torch_exp_se3
from fields.map.gaussians import SH_C0, GaussianField
from fields.map.keyframe import Keyframe
from fields.runtime.backend import initialise
from pipelines.optimise.map_optimiser import MapOptimiser
from pipelines.render.rasterize import RasterizedView, rasterize
from pipelines.render.renderer import Renderer
from pipelines.settings import MappingSettings
from tests.pipelines import reference
from tests.pipelines.optimise.test_map_optimiser import MOTION, store_of_views
from tests.pipelines.scenes import CAMERA, NEAR, POSE, random_gaussians

NAMES = ("position", "log_scale", "quaternion", "opacity_logit", "sh")
BACKGROUND = (0.2, 0.5, 0.9)
LARGE = PinholeCamera(80.0, 80.0, 50.0, 40.0, 100, 70)


def tensors(state: dict[str, NDArray], kind: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """The Gaussians as leaves that ask for gradients."""
    return {name: torch.from_numpy(state[name]).to(kind).requires_grad_() for name in NAMES}


def view(
    gaussians: dict[str, Tensor], T: NDArray | Tensor = POSE, camera: PinholeCamera = CAMERA, **options: object
) -> RasterizedView:
    return rasterize(**gaussians, T_camera_world=torch.as_tensor(T), camera=camera, near=NEAR, **options)


def gradients_of(picture: RasterizedView, inputs: dict[str, Tensor]) -> dict[str, NDArray]:
    """Of a fixed functional of all three outputs."""
    generator = torch.Generator().manual_seed(1)
    weights = (torch.randn(output.shape, generator=generator, dtype=output.dtype) for output in picture)
    loss = sum((output * weight).sum() for output, weight in zip(picture, weights, strict=True))
    return dict(zip(inputs, (g.numpy() for g in torch.autograd.grad(loss, list(inputs.values()))), strict=True))


@pytest.fixture
def scene() -> dict[str, Tensor]:
    return tensors(random_gaussians(60, seed=4, degree=1))


@pytest.fixture
def anew(taichi_on_the_cpu: None) -> Iterator[None]:
    """Taichi without any fields, before and after: a process keeps those of two kinds of call."""
    initialise("cpu")
    yield
    initialise("cpu")


# ---- pictures -------------------------------------------------------------------------------------------------


def test_pictures_are_those_of_the_plain_renderer() -> None:
    state = random_gaussians(60, seed=4, degree=1)
    expected = reference.render(state, CAMERA, POSE, NEAR, BACKGROUND)
    picture = view(tensors(state), background=torch.tensor(BACKGROUND))
    assert [tuple(output.shape) for output in picture] == [(35, 43, 3), (35, 43), (35, 43)]
    for output, truth in zip(picture, (expected.colour, expected.depth, expected.opacity), strict=True):
        assert output.dtype == torch.float32
        np.testing.assert_allclose(output.detach(), truth, rtol=0, atol=2e-4)


# ---- gradients ------------------------------------------------------------------------------------------------


def test_the_gradient_of_a_pose_is_that_of_the_tangent_it_was_made_from(scene: dict[str, Tensor]) -> None:
    """By way of the 4x4 matrix, as the renderer itself has it."""
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    found = gradients_of(view(scene, torch_exp_se3(xi) @ torch.from_numpy(POSE)), {"xi": xi})["xi"]
    T = torch.from_numpy(POSE).requires_grad_()
    G = gradients_of(view(scene, T), {"T": T})["T"]
    numeric = [((exp_se3(1e-6 * e) - exp_se3(-1e-6 * e)) / 2e-6 @ POSE * G).sum() for e in np.eye(6)]
    assert np.abs(found).max() > 1
    np.testing.assert_allclose(found, numeric, rtol=1e-6, atol=1e-6 * np.abs(found).max())


@pytest.mark.slow
def test_a_gradient_does_not_mind_pictures_drawn_in_between(scene: dict[str, Tensor]) -> None:
    T = torch.from_numpy(POSE).requires_grad_()
    inputs = scene | {"T": T}
    expected = gradients_of(view(scene, T), inputs)
    picture = view(scene, T)
    view(tensors(random_gaussians(200, seed=9, degree=1)), exp_se3(MOTION) @ POSE)
    view(tensors(random_gaussians(20, seed=9, degree=1)), camera=LARGE)
    found = gradients_of(picture, inputs)
    for name, value in expected.items():
        assert np.abs(value).max() > 0
        np.testing.assert_array_equal(found[name], value)


# ---- what does not fit ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "error", "named"),
    [
        ({"position": np.zeros((60, 3))}, TypeError, "position"),
        ({"sh": torch.zeros(60, 4, 3, dtype=torch.float16)}, TypeError, "sh"),
        ({"log_scale": torch.zeros(60, 3).double()}, TypeError, "log_scale"),
        ({"log_scale": torch.zeros(60, 3, device="meta")}, ValueError, "log_scale"),
        ({"position": torch.zeros(3)}, ValueError, "position"),
        ({"quaternion": torch.ones(60, 3)}, ValueError, "quaternion"),
        ({"opacity_logit": torch.ones(60, 1)}, ValueError, "opacity_logit"),
        ({"sh": torch.ones(60, 5, 3)}, ValueError, "sh"),
        ({"background": torch.ones(4)}, ValueError, "background"),
        ({"T_camera_world": torch.eye(3)}, ValueError, "T_camera_world"),
        ({"T_camera_world": 1.1 * torch.eye(4)}, ValueError, "T_camera_world"),
        ({"T_camera_world": -torch.eye(4)}, ValueError, "T_camera_world"),
        ({"log_scale": torch.full((60, 3), torch.nan)}, ValueError, "log_scale"),
        ({"quaternion": torch.eye(60, 4)}, ValueError, "quaternion"),
        ({"colour": torch.ones(60, 3)}, TypeError, "colour"),
        ({"near": float("nan")}, ValueError, "near"),
        ({"near": 0.0}, ValueError, "near"),
        ({"near": -1.0}, ValueError, "near"),
        ({"log_scale": torch.eye(60, 3) * 25.0, "position": torch.ones(60, 3)}, ValueError, "log_scale"),
    ],
)
def test_what_does_not_fit_is_named_in_one_line(
    scene: dict[str, Tensor], changes: dict[str, object], error: type[Exception], named: str
) -> None:
    with pytest.raises(error, match=rf"\b{named}\b") as told:
        rasterize(**{**scene, "T_camera_world": torch.eye(4), "camera": CAMERA, **changes})
    assert "\n" not in str(told.value)


# ---- room, and Taichi started anew ----------------------------------------------------------------------------


@pytest.mark.slow
def test_another_set_of_fields_than_there_is_room_for_takes_the_place_of_the_others(
    anew: None, scene: dict[str, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipelines.render.rasterize.MAX_KEPT", 2)
    plain = scene | {"sh": scene["sh"][:, :1]}
    expected = view(scene)
    view(scene, camera=LARGE)
    view(plain)
    torch.testing.assert_close(view(scene), expected, rtol=0, atol=0)
    assert view(plain).image.sum() > 0


@pytest.mark.slow
def test_no_set_of_fields_takes_the_place_of_what_is_in_use(
    anew: None, scene: dict[str, Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipelines.render.rasterize.MAX_KEPT", 1)
    gaussians = GaussianField(0, 1024)
    expected = view(scene)
    with pytest.raises(RuntimeError, match=r"^[^\n]+$"):
        view(scene, camera=LARGE)
    torch.testing.assert_close(view(scene), expected, rtol=0, atol=0)
    assert len(gaussians.to_numpy()["position"]) == 0


@pytest.mark.slow
def test_threads_get_each_its_own_picture_and_gradient(anew: None) -> None:
    scenes = [tensors(random_gaussians(60, seed=seed, degree=1)) for seed in range(4)]

    def drawn(scene: dict[str, Tensor]) -> dict[str, NDArray]:
        picture = view(scene)
        return {"image": picture.image.detach().numpy(), **gradients_of(picture, scene)}

    expected = [drawn(scene) for scene in scenes]
    with ThreadPoolExecutor(4) as pool:
        for found, truth in zip(pool.map(drawn, scenes * 5), expected * 5, strict=True):
            for name in truth:
                np.testing.assert_array_equal(found[name], truth[name])


@pytest.mark.slow
def test_a_gradient_outlives_a_new_start_of_the_engine(anew: None, scene: dict[str, Tensor]) -> None:
    expected = gradients_of(view(scene), scene)
    picture = view(scene)
    initialise("cpu", threads=1)
    for found in (gradients_of(picture, scene), gradients_of(view(scene), scene)):
        for name, value in expected.items():
            np.testing.assert_array_equal(found[name], value)


# ---- training -------------------------------------------------------------------------------------------------

STEPS = 300
SSIM_WEIGHT = 0.2


def loss_in_torch(render: Tensor, keyframe: Keyframe) -> Tensor:
    """(1 - w) L1 + w (1 - SSIM) over the valid pixels, as `losses.py` says it."""
    rgba = torch.from_numpy(keyframe.rgba)
    valid, truth = rgba[..., 3] > 0, rgba[..., :3] / 255.0
    a, b = (x.permute(2, 0, 1) for x in (torch.where(valid[..., None], render, truth), truth))
    weights = torch.exp(-0.5 * (torch.arange(-5.0, 6.0) / 1.5) ** 2)
    window = torch.outer(weights, weights)[None, None] / weights.sum() ** 2
    mu_a, mu_b, aa, bb, ab = conv2d(torch.cat([a, b, a * a, b * b, a * b])[:, None], window, padding=5).split(3)
    variances, covariance = aa + bb - mu_a**2 - mu_b**2, ab - mu_a * mu_b
    ssim = (2 * mu_a * mu_b + 1e-4) * (2 * covariance + 9e-4) / ((mu_a**2 + mu_b**2 + 1e-4) * (variances + 9e-4))
    l1 = (a - b).abs()[:, valid].mean()
    return (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - ssim[:, 0][:, valid].mean())


@pytest.mark.slow
def test_a_plain_torch_loop_trains_as_our_own_does(anew: None) -> None:
    """The same start, views, loss and rates: the curves lie on one another, though rounding parts the paths."""
    store = store_of_views([POSE, exp_se3(MOTION) @ POSE, exp_se3(-np.array(MOTION)) @ POSE])
    start = random_gaussians(200, seed=32, degree=1, size=(1.5, 5.0))
    settings = MappingSettings(near=0.01, optimise={"aspect_weight": 0.0, "ssim_weight": SSIM_WEIGHT})

    leaves = {name: value.detach() for name, value in tensors(start).items() if name != "sh"}
    sh = torch.from_numpy(start["sh"]).float()
    leaves |= {"constant": sh[:, :1].clone(), "directional": sh[:, 1:].clone()}
    o, depth = settings.optimise, store.scene_depth
    rates = (o.position_rate * depth, o.scale_rate, o.rotation_rate, o.opacity_rate, o.colour_rate, o.colour_rate / 20)
    groups = [{"params": [v.requires_grad_()], "lr": r} for v, r in zip(leaves.values(), rates, strict=True)]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15)
    torch_curve = []
    for step in range(STEPS):
        keyframe = store[step % 3]
        picture = rasterize(
            *(leaves[name] for name in NAMES[:4]),
            torch.cat([leaves["constant"], leaves["directional"]], dim=1),
            T_camera_world=torch.from_numpy(keyframe.T_camera_world),
            camera=keyframe.camera,
            near=settings.near * depth,
        )
        loss = loss_in_torch(picture.image, keyframe)
        adam.zero_grad()
        loss.backward()
        adam.step()
        torch_curve.append(loss.item())

    renderer = Renderer(GaussianField(1, max_gaussians=1 << 16), 64, 64)
    renderer.gaussians.load(start)
    optimiser = MapOptimiser(renderer.gaussians, renderer, settings)
    our_curve = []
    for step in range(STEPS):
        values = optimiser.compare(store[step % 3], depth)
        our_curve.append((1 - SSIM_WEIGHT) * values.l1 + SSIM_WEIGHT * (1 - values.ssim))
        optimiser.step(store, [step % 3], optimiser.rates(depth), pose_rate=0.0)

    np.testing.assert_allclose(torch_curve[:3], our_curve[:3], rtol=1e-4)
    beginnings, ends = (
        [np.mean(curve[part]) for curve in (torch_curve, our_curve)] for part in (slice(9), slice(-9, None))
    )
    print(f"loss of the torch loop {beginnings[0]:.4f} -> {ends[0]:.4f}, of ours {beginnings[1]:.4f} -> {ends[1]:.4f}")
    assert ends[1] < 0.75 * beginnings[1]
    assert ends[0] == pytest.approx(ends[1], rel=0.02)


# ---- in float64 ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_gradcheck_in_float64_by_every_input(anew: None) -> None:
    """All sixteen numbers of the pose too, the background, and each of the three outputs."""
    camera = PinholeCamera(9.0, 8.0, 4.2, 2.8, 9, 6)
    # Across the whole picture above the cut at 1/255, so that it is smooth in all.
    state = random_gaussians(3, seed=3, degree=1, camera=camera, size=(4.0, 8.0), logit=(0.0, 1.5), beyond=-0.2)
    inputs = tensors(state, torch.float64)
    T, background = (
        torch.tensor(value, dtype=torch.float64, requires_grad=True) for value in (POSE.tolist(), BACKGROUND)
    )

    def outputs(*values: Tensor) -> tuple[Tensor, ...]:
        gaussians = dict(zip(NAMES, values, strict=False))
        return tuple(view(gaussians, values[5], camera, background=values[6]))

    assert torch.autograd.gradcheck(outputs, (*inputs.values(), T, background))


def test_a_colour_is_the_constant_harmonic(anew: None, scene: dict[str, Tensor]) -> None:
    sh = scene["sh"][:, :1]
    colour = 0.5 + SH_C0 * sh[:, 0]
    geometry = {name: value for name, value in scene.items() if name != "sh"}
    plain = view(geometry, colour=colour)
    np.testing.assert_allclose(plain.image.detach(), view(geometry | {"sh": sh}).image.detach(), atol=1e-6)
