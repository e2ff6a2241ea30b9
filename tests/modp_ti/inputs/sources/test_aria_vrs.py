"""An Aria recording: undistorted as its calibration says, on the device's clock, with its vignetting mask.

The real recording of the sample data, read with projectaria-tools, where both are there. Oracle: the library's own
projection, ray by ray, and its own (slower) undistortion.
"""

from __future__ import annotations

import importlib.util

import cv2
import numpy as np
import pytest

from modp_ti.inputs.opening import open_source
from modp_ti.inputs.source_settings import SourceSettings, VrsSettings
from modp_ti.inputs.sources import FrameReader

needs_library = pytest.mark.skipif(
    importlib.util.find_spec("projectaria_tools") is None, reason="projectaria-tools is not installed"
)


@pytest.fixture
def recording(shared_data):
    return shared_data("aria") / "aria_unit_test_timecode_sequence_calib.vrs"


@pytest.fixture
def mask(shared_data):
    return shared_data("aria") / "vignetting_mask" / "rgb_vignetting_half_reso_mask.png"


@pytest.fixture
def library(recording):
    from projectaria_tools.core import data_provider

    return data_provider.create_vrs_data_provider(str(recording))


@needs_library
def test_images_are_those_of_the_librarys_undistortion_on_the_devices_clock(recording, library):
    from projectaria_tools.core import calibration

    made = open_source(SourceSettings(path=recording))
    assert tuple(made.names) == tuple(f"{recording.stem}_{i:06d}" for i in range(4))
    stream = library.get_stream_id_from_label("camera-rgb")
    fisheye = library.get_device_calibration().get_camera_calib("camera-rgb")
    pinhole = calibration.get_linear_camera_calibration(800, 800, 400)
    for i, name in enumerate(made.names):
        data, record = library.get_image_data_by_index(stream, i)
        assert made.timestamp(name) == pytest.approx(record.capture_timestamp_ns * 1e-9, abs=1e-9)
        expected = calibration.distort_by_calibration(data.to_numpy_array(), pinhole, fisheye)
        # Theirs picks single pixels of the larger image, ours averages them: the same but for noise, and much nearer
        # than pictures that are one pixel apart.
        ours, theirs = (cv2.blur(image, (3, 3)).astype(int) for image in (made.read(name), expected))
        assert np.abs(ours - theirs).mean() < 0.4 * np.abs(ours[1:] - theirs[:-1]).mean()
    assert "lies on its side as it was recorded: the scene's up is the image's left" in made.notes[0]
    np.testing.assert_allclose(made.T_device_camera, fisheye.get_transform_device_camera().to_matrix())


@needs_library
@pytest.mark.parametrize("pinhole", [VrsSettings(), VrsSettings(width=640, height=480, focal=250.0)])
def test_ray_lands_where_intrinsics_and_calibration_both_put_it(recording, library, pinhole):
    """Stored fisheye images that hold their own coordinates: the pinhole image then says where it looked."""
    made = open_source(SourceSettings(path=recording, vrs=pinhole))
    camera = made.intrinsics.camera
    assert (camera.width, camera.height) == (pinhole.width, pinhole.height) == made.size(made.names[0])
    fisheye = library.get_device_calibration().get_camera_calib("camera-rgb")
    x, y = np.meshgrid(np.arange(1408, dtype=np.float32), np.arange(1408, dtype=np.float32))
    looked = made._rectification(np.dstack([x, y, x]))
    off = []
    for column, row in np.random.default_rng(2).integers(20, (camera.width - 20, camera.height - 20), (200, 2)):
        ray = np.array([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0])
        # cv2.remap looks at 1/32 of a pixel of the shrunk image.
        off.append(looked[row, column, :2] - fisheye.project(ray))
    assert np.abs(off).max() < 0.3
    assert np.abs(np.mean(off, axis=0)).max() < 0.02


@needs_library
def test_vignetting_mask_is_undistorted_with_the_images(recording, mask):
    settings = SourceSettings(path=recording, vignette=mask, scale=0.5)
    made = open_source(settings)
    assert len(made.notes) == 1, "it is not asked for"
    light = cv2.imread(str(mask))[..., ::-1] / 255.0
    assert np.abs(made.vignette[395:405, 395:405] - light[705:715, 705:715]).max() < 0.02
    assert made.vignette[5, 5].max() < 0.6 < made.vignette[400, 400].min()
    picture = FrameReader(made, settings).read(made.names[0], made.intrinsics.undistorter(0.5))
    assert picture.image.shape == picture.vignette.shape == (400, 400, 3)
