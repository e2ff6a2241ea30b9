from __future__ import annotations

import numpy as np
import torch

from pipelines.densify.depth.gaussian_process import matern32, nonstationary_matern32, nonstationary_variance


def covariances(count: int, seed: int) -> torch.Tensor:
    A = np.random.default_rng(seed).normal(size=(count, 2, 2))
    E = A @ A.transpose(0, 2, 1) + 0.05 * np.eye(2)
    return torch.from_numpy(np.stack([E[:, 0, 0], E[:, 0, 1], E[:, 1, 1]], 1))


def places(count: int, seed: int) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-1, 1, (count, 2)))


def test_equal_covariances_give_the_matern_process_of_their_metric() -> None:
    p, q = places(7, 1), places(5, 2)
    E = covariances(1, 3)
    A = np.array([[E[0, 0], E[0, 1]], [E[0, 1], E[0, 2]]])
    d = (p[:, None] - q[None]).numpy()
    distance = np.sqrt(np.einsum("nmi,ij,nmj->nm", d, np.linalg.inv(2 * A), d) / 2)
    kernel = nonstationary_matern32(p, E.expand(7, 3), q, E.expand(5, 3))
    torch.testing.assert_close(kernel, matern32(torch.from_numpy(distance)), rtol=1e-5, atol=1e-6)


def test_varying_covariances_stay_a_process() -> None:
    p, E = places(60, 4), covariances(60, 5)
    K = nonstationary_matern32(p, E, p, E)
    torch.testing.assert_close(K, K.T)
    assert torch.linalg.eigvalsh(K).min() > -1e-7
    assert (torch.diagonal(K) > 0.999).all()


def test_the_variance_is_the_diagonal() -> None:
    p, E = places(20, 6), torch.cat([covariances(10, 7), 1e-3 * covariances(10, 8)])
    torch.testing.assert_close(nonstationary_variance(E), torch.diagonal(nonstationary_matern32(p, E, p, E)))
