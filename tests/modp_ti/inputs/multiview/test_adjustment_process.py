"""Bundle adjustment in a process of its own."""

from __future__ import annotations

import numpy as np

from fields.geometry.se3 import exp_se3
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.multiview.bundle_adjustment import adjusted_apart, adjusted_bundle


def test_a_process_of_its_own_finds_the_same_as_this_one():
    rng = np.random.default_rng(0)
    lens = Lens.radial(300.0, 0.0, 320, 240)
    xyz = np.c_[rng.uniform(-1, 1, (50, 2)), rng.uniform(3, 5, 50)]
    poses = {k: exp_se3([-0.2 * k, 0, 0, 0, 0.02 * k, 0]) for k in range(3)}
    pixels = np.concatenate([lens.pixels(xyz @ T[:3, :3].T + T[:3, 3]) for T in poses.values()])
    pixels += rng.normal(0, 0.5, pixels.shape)
    view, point = np.repeat(np.arange(3), 50), np.tile(np.arange(50), 3)
    arguments = (lens.camera, poses, view, point, pixels, xyz + rng.normal(0, 0.02, xyz.shape), {1, 2}, 20)
    here, there = adjusted_bundle(*arguments), adjusted_apart(*arguments)
    assert here is not None and there is not None
    assert there.cost == here.cost < 0.25
    np.testing.assert_array_equal(there.xyz, here.xyz)
    for k, T in here.poses.items():
        np.testing.assert_array_equal(there.poses[k], T)


def test_a_process_that_ends_early_brings_nothing(monkeypatch):
    monkeypatch.setattr("modp_ti.inputs.multiview.bundle_adjustment.CODE", "import os; os._exit(137)")
    assert adjusted_apart() is None
