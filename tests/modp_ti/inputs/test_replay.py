"""What all replayed trackers share: poses are checked, points are those that the delivered image shows."""

from __future__ import annotations

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from modp_ti.inputs import posed_recording
from modp_ti.inputs.replay import points_inside
from modp_ti.inputs.sources import Undistorter
from tests.opening import opened, refusal
from tests.samples.filmed import write_image
from tests.samples.kinds import write_sample


def test_only_known_points_before_the_camera_and_inside_the_image_are_delivered():
    undistorter = Undistorter(PinholeCamera(100, 100, 50, 40, 100, 80))
    xyz = np.array([[0, 0, 2.0], [0, 0, -2.0], [0, 0, 3.0], [0, 0, 3.0], [np.nan, 0, 1.0]])
    pixels = np.array([[50, 40], [50, 40], [100.0, 40], [np.nan, 1], [5, 5]])
    points = points_inside(xyz, pixels, np.arange(10, 15), undistorter, np.eye(4))
    assert points.ids.tolist() == [10]
    assert points.xyz.tolist() == [[0, 0, 2]] and points.pixels.tolist() == [[50, 40]]


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_masks_of_the_source_reach_the_frames_and_take_their_points_away(filmed, tmp_path, kind):
    """Valid in the upper two thirds, painted over in the left quarter; at half size."""
    write_sample(kind, tmp_path / "a", filmed)
    plain = list(opened(tmp_path / "a", "source.scale=0.5"))
    mask = np.zeros(filmed.size[::-1], np.uint8)
    mask[:160] = 255
    for name, view in zip(filmed.names, filmed.views, strict=True):
        write_image(tmp_path / "masks" / name, mask)
        painted = view.image.copy()
        painted[:, :80] = (0, 0, 255)
        write_image(tmp_path / "a/images" / name, painted)
    masks = f"source.masks={tmp_path / 'masks'}"
    masked = list(opened(tmp_path / "a", "source.scale=0.5", masks, "source.mask_colour=[255, 0, 0]"))
    for before, after in zip(plain, masked, strict=True):
        assert after.mask is not None and after.mask[:80, 40:].all()
        assert not after.mask[80:].any() and not after.mask[:, :40].any()
        column, row = after.points.pixels.astype(int).T
        assert after.mask[row, column].all() and 0 < len(after.points) < len(before.points)
        np.testing.assert_allclose(after.image[:80, 40:], before.image[:80, 40:], atol=0.01)


def test_a_missing_mask_ends_the_run_before_the_points_are_triangulated(filmed, tmp_path, monkeypatch):
    write_sample("matrices", tmp_path / "a", filmed)
    write_image(tmp_path / "masks" / filmed.names[0], np.full(filmed.size[::-1], 255, np.uint8))
    monkeypatch.setattr(posed_recording, "triangulated_frames", lambda *_: pytest.fail("it began"))
    said = refusal(tmp_path / "a", f"source.masks={tmp_path / 'masks'}", "tracker.points=null")
    assert "has no mask for view9.png" in said
