"""DepthCov: its depth, its network and its checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates
from torch.nn import functional

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.map.keyframe import Keyframe
from fields.map.keyframes import KeyframeStore
from pipelines.densify.depth.depthcov import DepthCov, DepthCovWeights, load_depthcov, pixel_covariances
from pipelines.settings import DepthSettings
from pipelines.torch_checkpoint import read_checkpoint


def view(pixels: np.ndarray, depth: np.ndarray, width: int = 96, height: int = 64) -> Keyframe:
    """A view of a coloured pattern that is the same at every size."""
    camera = PinholeCamera(80.0, 80.0, width / 2, height / 2, width, height)
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    image = 0.5 + 0.5 * np.stack([np.sin(5 * x), np.cos(4 * y + x), np.sign(np.sin(3 * x * y))], 2)
    points = SparsePoints(camera.unproject(pixels, depth), pixels, np.arange(len(pixels)))
    return KeyframeStore().append(TrackedFrame(0, 0.0, "v", image.astype(np.float32), camera, np.eye(4), points))


@pytest.fixture(scope="module")
def weights(checkpoint: Path) -> DepthCovWeights:
    return load_depthcov(checkpoint)


@pytest.fixture
def points() -> tuple[np.ndarray, np.ndarray]:
    """Pixels (60, 2) and depths of a 96x64 view; some lie in the border's half pixel."""
    rng = np.random.default_rng(3)
    pixels = rng.uniform([0, 0], [96, 64], (60, 2))
    pixels[:2] = [[0.1, 0.2], [95.8, 63.9]]
    return pixels, np.exp(0.5 + 0.01 * pixels[:, 0] + rng.normal(0, 0.05, 60))


def estimator(weights: DepthCovWeights, **settings: float) -> DepthCov:
    return DepthCov(DepthSettings(**settings), weights, np.random.default_rng(0))


ASKED = np.random.default_rng(4).uniform([0, 0], [96, 64], (25, 2))


def test_the_regression_is_the_closed_form(weights: DepthCovWeights, points: tuple[np.ndarray, np.ndarray]) -> None:
    pixels, depth = points
    process = estimator(weights)
    v = view(pixels, depth)
    estimate = process.estimate(v, [], ASKED)

    maps = process.covariances(v.rgba)[0].double().numpy()  # (3, 64, 96)
    s, noise = np.exp(-1.25), 1e-2 * np.exp(-2.5)

    def place(pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(row, column) in [-1, 1], and E there."""
        row, column = pixel[1] - 0.5, pixel[0] - 0.5  # of pixel centres
        x, y, z = (map_coordinates(m, [[row], [column]], order=1, mode="reflect")[0] for m in maps)
        return np.array([2 * row / 64 + 1 / 64 - 1, 2 * column / 96 + 1 / 96 - 1]), np.array([[x, y], [y, z]])

    def kernel(one: tuple[np.ndarray, np.ndarray], two: tuple[np.ndarray, np.ndarray]) -> float:
        (p1, E1), (p2, E2) = one, two
        S = E1 + E2
        Q = (p1 - p2) @ np.linalg.inv(S) @ (p1 - p2) / 2
        C = 2 * (np.linalg.det(E1) * np.linalg.det(E2)) ** 0.25 / np.sqrt(np.linalg.det(S) + 1e-8)
        r = np.sqrt(3) * np.sqrt(Q + 1e-8)
        return s * C * (1 + r) * np.exp(-r)

    known, asked = [place(p) for p in pixels], [place(p) for p in ASKED]
    K = np.array([[kernel(a, b) for b in known] for a in known]) + noise * np.eye(len(known))
    k = np.array([[kernel(a, b) for b in known] for a in asked])
    y = np.log(depth)
    mean = y.mean() + k @ np.linalg.solve(K, y - y.mean())
    variance = [kernel(a, a) - row @ np.linalg.solve(K, row) for a, row in zip(asked, k, strict=True)]
    assert 0.05 < np.ptp(mean)
    np.testing.assert_allclose(np.log(estimate.depth), mean, atol=1e-5)  # the maps are sampled in float32
    np.testing.assert_allclose(estimate.deviation, np.sqrt(variance), rtol=1e-4)


@pytest.mark.parametrize(("width", "height"), [(75, 50), (200, 33), (20, 70)])
def test_any_image_size_gives_the_same_process(
    weights: DepthCovWeights, points: tuple[np.ndarray, np.ndarray], width: int, height: int
) -> None:
    """With a kernel that does not follow the image, only places relative to the image's sides matter."""
    pixels, depth = points
    constant = load_constant(weights)
    resize = np.array([width / 96, height / 64])
    reference = estimator(constant).estimate(view(pixels, depth), [], ASKED)
    estimate = estimator(constant).estimate(view(pixels * resize, depth, width, height), [], ASKED * resize)
    np.testing.assert_allclose(estimate.depth, reference.depth, rtol=1e-6)
    np.testing.assert_allclose(estimate.deviation, reference.deviation, rtol=1e-6)


def load_constant(weights: DepthCovWeights) -> DepthCovWeights:
    network = type(weights.network)()
    entries = dict(weights.network.state_dict())
    entries["feature_convs.0.weight"] = torch.zeros(3, 16, 1, 1)
    network.load_state_dict(entries)
    return DepthCovWeights(network.eval(), weights.log_scale, weights.log_noise)


def test_the_kernel_follows_the_image(weights: DepthCovWeights, points: tuple[np.ndarray, np.ndarray]) -> None:
    v = view(*points)
    before = estimator(weights).estimate(v, [], ASKED)
    v.rgba = v.rgba[:, ::-1]
    after = estimator(weights).estimate(v, [], ASKED)
    assert np.abs(after.deviation / before.deviation - 1).max() > 0.05


Entries = dict[str, torch.Tensor]


def test_every_weight_comes_to_its_place(checkpoint: Path, published: Entries) -> None:
    weights = load_depthcov(checkpoint)
    loaded = weights.network.state_dict()
    assert len(loaded) == 106
    for name, value in loaded.items():
        torch.testing.assert_close(value, published[f"gaussian_cov_net.{name}"], rtol=0, atol=0)
    assert weights.log_scale == pytest.approx(-1.25)  # of the finest level, index 3
    assert weights.log_noise == pytest.approx(-2.5)


def damaged(name: str, value: torch.Tensor | None) -> Callable[[Entries], Entries]:
    def change(entries: Entries) -> Entries:
        entries = {**entries, name: value}
        return {key: v for key, v in entries.items() if v is not None}

    return change


WEIGHT = "gaussian_cov_net.up_convs.3.conv_block.conv2.weight"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (damaged(WEIGHT, None), f"entry `{WEIGHT}` is missing"),
        (damaged(WEIGHT, torch.zeros(128, 256, 3, 3)), rf"`{WEIGHT}` has shape \(128, 256, 3, 3\).*\(128, 128, 3, 3\)"),
        (damaged(WEIGHT, torch.full((128, 128, 3, 3), torch.nan)), f"entry `{WEIGHT}` holds NaN"),
        (damaged("gaussian_cov_net.extra.bias", torch.zeros(3)), "entry `gaussian_cov_net.extra.bias` is unexpected"),
        (damaged("log_depth_var_scales.2", None), "entry `log_depth_var_scales.2` is missing"),
        (damaged("log_depth_var_scales.2", torch.zeros(2)), r"`log_depth_var_scales.2` has shape \(2,\)"),
        (damaged("cross_cov_modules.1.scale_param", torch.tensor(0.5)), "`cross_cov_modules.1.scale_param` is 0.5"),
    ],
)
def test_damage_is_refused_with_the_entry_s_name(
    published: Entries, tmp_path: Path, change: Callable[[Entries], Entries], said: str
) -> None:
    path = tmp_path / "damaged.ckpt"
    torch.save({"state_dict": change(published)}, path)
    with pytest.raises(ValueError, match=said) as caught:
        load_depthcov(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_numbers_may_be_written_with_an_axis(published: Entries, tmp_path: Path) -> None:
    scalars = {name: value[None] if value.ndim == 0 else value for name, value in published.items()}
    torch.save({"state_dict": scalars}, tmp_path / "axis.ckpt")
    assert load_depthcov(tmp_path / "axis.ckpt").log_scale == pytest.approx(-1.25)


def group_norm(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
    _, c, h, w = x.shape
    groups = x.reshape(16, c // 16 * h * w)
    groups = (groups - groups.mean(1, keepdim=True)) / (groups.var(1, unbiased=False, keepdim=True) + 1e-5).sqrt()
    return groups.reshape(x.shape) * weight[:, None, None] + bias[:, None, None]


def leaky(x: torch.Tensor) -> torch.Tensor:
    return torch.where(x > 0, x, 0.01 * x)


def block(net: Entries, name: str, x: torch.Tensor) -> torch.Tensor:
    def conv(which: str, x: torch.Tensor, padding: int) -> torch.Tensor:
        return functional.conv2d(x, net[f"{name}.{which}.weight"], net[f"{name}.{which}.bias"], padding=padding)

    norm = net[f"{name}.norm.weight"], net[f"{name}.norm.bias"]
    y = leaky(group_norm(conv("conv1", x, 1), *norm))
    y = group_norm(conv("conv2", y, 1), *norm)
    return leaky(conv("conv3", x, 0) + y)


def twice(x: torch.Tensor, dim: int) -> torch.Tensor:
    """Bilinear doubling along one axis: the new pixels lie a quarter pixel beside the old ones."""
    n = x.shape[dim]
    before = torch.cat([x.narrow(dim, 0, 1), x.narrow(dim, 0, n - 1)], dim)
    after = torch.cat([x.narrow(dim, 1, n - 1), x.narrow(dim, n - 1, 1)], dim)
    return torch.stack([0.75 * x + 0.25 * before, 0.75 * x + 0.25 * after], dim + 1).flatten(dim, dim + 1)


def plain_network(published: Entries, image: torch.Tensor) -> torch.Tensor:
    net = {name.removeprefix("gaussian_cov_net."): value.double() for name, value in published.items()}
    mean, std = torch.tensor([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]], dtype=torch.float64)[..., None, None]
    levels = [block(net, "base", (image.double() - mean) / std)]
    for i in range(5):
        x = levels[-1]
        x = x.unfold(2, 2, 2).unfold(3, 2, 2).amax((-1, -2))
        levels.append(block(net, f"down_convs.{i}.conv_block", x))
    x = levels.pop()
    for i in (4, 3, 2, 1, 0):
        x = twice(twice(x, 2), 3)
        x = functional.conv2d(
            x, net[f"up_convs.{i}.upsample.1.weight"], net[f"up_convs.{i}.upsample.1.bias"], padding=1
        )
        x = block(net, f"up_convs.{i}.conv_block", torch.cat([x, levels[i]], 1))
    return functional.conv2d(x, net["feature_convs.0.weight"], net["feature_convs.0.bias"])


def test_the_network_is_the_one_described(checkpoint: Path, published: Entries) -> None:
    image = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        raw = load_depthcov(checkpoint).network(image)
    expected = plain_network(published, image)
    assert raw.shape == (1, 3, 64, 96)
    assert expected.std(dim=(2, 3)).min() > 0.1  # it says something of the image
    torch.testing.assert_close(raw.double(), expected, rtol=1e-3, atol=1e-3)


def test_covariances_are_positive_definite_and_within_their_bounds() -> None:
    raw = torch.tensor([[-50.0, 50.0, 0.0, 3.0, -50.0], [-50.0, -50.0, 1.0, 3.0, -50.0], [0.0, 9.0, 0.5, -9.0, 9.0]])
    rr, rc, cc = pixel_covariances(raw[None, :, None])[0, :, 0]
    torch.testing.assert_close(rr, torch.tensor([1e-3, 1e4, 1.0, 3.0, 1e-3]).where(raw[0] != 3, raw[0].exp()))
    torch.testing.assert_close(cc, torch.tensor([1e-3, 1e-3, 1.0, 3.0, 1e-3]).where(raw[1].abs() > 5, raw[1].exp()))
    correlation = rc / torch.sqrt(rr * cc - 1e-8)
    torch.testing.assert_close(correlation, 0.99 * torch.tanh(raw[2]))
    assert (rr * cc - rc**2 > 0).all()


class Harmful:
    """Unpickling this runs a command."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (type(self.target).touch, (self.target,))


def test_pickled_code_is_not_run(tmp_path: Path) -> None:
    path, target = tmp_path / "harmful.pth", tmp_path / "touched"
    torch.save({"weight": torch.zeros(2), "more": Harmful(target)}, path)
    with pytest.raises(ValueError, match="weights") as caught:
        read_checkpoint(path)
    assert "\n" not in str(caught.value)
    assert not target.exists()
    torch.load(path, weights_only=False)
    assert target.exists()  # it would have


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such file"):
        read_checkpoint(tmp_path / "w.pth")
    (tmp_path / "w.pth").write_bytes(b"not a file of torch")
    with pytest.raises(ValueError, match=r"w\.pth"):
        read_checkpoint(tmp_path / "w.pth")
    torch.save({"model": {}}, tmp_path / "w.pth")
    with pytest.raises(ValueError, match="state_dict"):
        read_checkpoint(tmp_path / "w.pth", "state_dict")


def test_entries_come_as_float32_in_either_of_torch_s_formats(tmp_path: Path) -> None:
    for zipped in (True, False):
        path = tmp_path / f"{zipped}.pth"
        torch.save({"w": torch.arange(4, dtype=torch.float64)}, path, _use_new_zipfile_serialization=zipped)
        torch.testing.assert_close(read_checkpoint(path)["w"], torch.arange(4, dtype=torch.float32))
