"""Source `vrs`: the RGB camera of a Project Aria recording, undistorted to pinhole images."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from modp_ti.files import open_file, reading
from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.frame_reader import read_vignette
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.sources.undistortion import Intrinsics

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import VrsSettings

RGB = "camera-rgb"


class AriaRecording(ImageSource):
    """An `ImageSource` of the stream `camera-rgb` of a VRS file. Frame n is called `<file stem>_<n, six digits>`.

    Images are resampled to a pinhole camera with the position and axes of the fisheye camera. Aria's RGB camera is
    mounted on its side, so that the scene's "up" is the image's left. Times are those of capture on the device clock
    [s], as in MPS trajectories.

    Args:
        path: The VRS file.
        pinhole: Size and focal length of the pinhole images.
        mask: Aria's vignetting mask of the recorded image.

    Attributes:
        T_device_camera: Pose (4, 4), camera to device, OpenCV axes, from the recording's calibration.
        vignette: Share of the light (H, W, 3) that reaches each part of the pinhole image, 0 outside the fisheye's
            field of view. None if there is no mask and the field of view covers the whole image.

    Raises:
        InputError: If projectaria-tools is not installed, the file is missing or not a recording, it has no RGB images
            or no calibration of them, or the mask does not have the recorded size.
    """

    def __init__(self, path: Path, pinhole: VrsSettings, mask: Path | None = None) -> None:
        try:
            # The extra `aria`, which need not be installed.
            from projectaria_tools.core import (  # pyright: ignore[reportMissingImports]
                calibration,
                data_provider,
                sensor_data,
            )
        except ImportError as error:
            raise InputError(
                f"{path}: reading a VRS recording needs projectaria-tools ({error}): pip install 'modp-ti[aria]'"
            ) from None
        self._lock = Lock()
        provider, self._stream = _opened(data_provider, path)
        self._provider: Any = provider
        device = provider.get_device_calibration()
        fisheye = None if device is None else device.get_camera_calib(RGB)
        if fisheye is None:
            raise InputError(f"{path}: holds no calibration of {RGB}, without which its images cannot be undistorted")
        nanoseconds = provider.get_timestamps_ns(self._stream, sensor_data.TimeDomain.DEVICE_TIME)
        times = np.array(nanoseconds, dtype=np.float64) * 1e-9
        super().__init__(path, [f"{path.stem}_{i:06d}" for i in range(len(times))], times)
        self.T_device_camera = np.asarray(fisheye.get_transform_device_camera().to_matrix())

        raw = self._recorded(0)
        width, height = map(int, fisheye.get_image_size())
        if raw.shape[:2] != (height, width):
            raise InputError(
                f"{path}: images of {RGB} are {raw.shape[1]}x{raw.shape[0]}, their calibration is for {width}x{height}"
            )
        camera = calibration.get_linear_camera_calibration(pinhole.width, pinhole.height, pinhole.focal)
        self._rectification = _Rectification(calibration.distort_by_calibration, camera, fisheye)
        fx, fy = (float(value) for value in camera.get_focal_lengths())
        cx, cy = (float(value) for value in camera.get_principal_point())  # with pixel centres at whole numbers
        self.intrinsics = Intrinsics(PinholeCamera(fx, fy, cx + 0.5, cy + 0.5, pinhole.width, pinhole.height))
        self._size = (pinhole.width, pinhole.height)
        covered = self._rectification.covered
        if mask is not None:
            light = read_vignette(mask)
            if light.shape[:2] != (height, width):
                raise InputError(
                    f"{mask} is {light.shape[1]}x{light.shape[0]}, the recorded images are {width}x{height}: give "
                    "Aria's mask of that size (rgb_vignetting_half_reso_mask.png is for 1408, ..._full_reso_mask.png "
                    "for 2880)"
                )
            self.vignette = np.where(covered[..., None], np.clip(self._rectification(light), 0.0, 1.0), 0.0)
        elif not covered.all():
            self.vignette = np.repeat(covered[..., None], 3, axis=2).astype(np.float32)
        self.add_note(
            f"{path.name} is undistorted to {pinhole.width}x{pinhole.height}, f = {pinhole.focal:g} px, and lies on "
            "its side as it was recorded: the scene's up is the image's left"
        )
        if mask is None:
            self.add_note(
                "Aria's lens darkens toward the edge: give its vignetting mask as source.vignette "
                "(rgb_vignetting_half_reso_mask.png or rgb_vignetting_full_reso_mask.png of Project Aria)"
            )

    def read(self, name: str) -> NDArray[np.uint8]:
        """Decode a pinhole image (H, W, 3) uint8 RGB, black outside the fisheye's field of view.

        Raises:
            InputError: If the recorded image cannot be decoded.
        """
        return self._rectification(self._recorded(self._position[name]))

    def close(self) -> None:
        """Close the recording."""
        with self._lock:
            self._provider = None

    def _recorded(self, index: int) -> NDArray[np.uint8]:
        """Decode the fisheye image (H, W, 3) uint8 RGB."""
        with self._lock:
            try:
                data, _ = self._provider.get_image_data_by_index(self._stream, index)
                image = data.to_numpy_array() if data.is_valid() else None
            except (RuntimeError, ValueError, IndexError):
                image = None
        if image is None or image.dtype != np.uint8:
            raise InputError(f"{self.path}: image {index} of {RGB} cannot be decoded; the recording is damaged there")
        return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)


class _Rectification:
    """Resamples fisheye images (H0, W0, 3), uint8 or float32, to the pinhole camera (H, W, 3).

    projectaria-tools' `distort_by_calibration` is called once to fill a lookup table. Resampling with the table is ten
    times as fast, and the image can be shrunk first to avoid aliasing.

    Attributes:
        covered: Pixels (H, W) inside the fisheye's field of view.
    """

    def __init__(self, distort, camera, fisheye) -> None:
        width, height = (int(value) for value in fisheye.get_image_size())
        # Images of the coordinates, starting at 1, because the library writes 0 outside the field of view.
        x, y = np.meshgrid(np.arange(1, width + 1, dtype=np.float32), np.arange(1, height + 1, dtype=np.float32))
        x, y = (np.asarray(distort(np.ascontiguousarray(plane), camera, fisheye)) for plane in (x, y))
        self.covered: NDArray[np.bool_] = (x > 0) & (y > 0)
        shrink = min(1.0, float(camera.get_focal_lengths()[0] / fisheye.get_focal_lengths()[0]))
        self._size = (round(width * shrink), round(height * shrink))
        # x - 1 is the coordinate with pixel centres at whole numbers, x - 0.5 at +0.5.
        self._x = ((x - 0.5) * (self._size[0] / width) - 0.5).astype(np.float32)
        self._y = ((y - 0.5) * (self._size[1] / height) - 0.5).astype(np.float32)

    def __call__(self, image: NDArray) -> NDArray:
        import cv2

        if self._size != (image.shape[1], image.shape[0]):
            image = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        image = cv2.remap(image, self._x, self._y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        image[~self.covered] = 0
        return image


def _opened(data_provider: Any, path: Path) -> tuple[Any, Any]:
    """Open a recording with the library's module. Returns its data provider and the id of the RGB stream."""
    with reading(path, " (source.path)"), _quiet():
        open_file(path).close()
        provider = data_provider.create_vrs_data_provider(str(path))
        if provider is None:
            raise ValueError("it is no VRS recording, or is cut off before its first image")
    labels = [provider.get_label_from_stream_id(stream) for stream in provider.get_all_streams()]
    stream = provider.get_stream_id_from_label(RGB) if RGB in labels else None
    if stream is None or provider.get_num_data(stream) == 0:
        raise InputError(
            f"{path}: holds no image of {RGB}, which the map is made of, only {', '.join(labels) or 'nothing'}: record "
            "with a profile that has RGB, or copy the file again"
        )
    return provider, stream


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the library, which writes to the process's file descriptors 1 and 2 directly."""
    kept = [os.dup(1), os.dup(2)]
    nothing = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 1)
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(kept[0], 1)
        os.dup2(kept[1], 2)
        for descriptor in (*kept, nothing):
            os.close(descriptor)
