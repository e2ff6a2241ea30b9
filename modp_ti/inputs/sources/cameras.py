"""The cameras of this machine that OpenCV can open, as `modp-ti cameras` lists them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from modp_ti.inputs.sources.image_pixels import quiet_opencv

LINUX_DEVICES = Path("/sys/class/video4linux")
# Numbers that are tried where the system lists no devices.
TRIED = 10


@dataclass(frozen=True)
class Camera:
    """A camera, or a device that looks like one and cannot be opened now.

    Attributes:
        number: For `source.stream` and `modp-ti run --stream`.
        name: Name of the device; empty if the system tells none.
        width: Image width [px], None if it is not known.
        height: Image height [px], None if it is not known.
        fps: Images per second, None if they are not known.
        opens: Whether OpenCV can open it. A camera that another program uses cannot be opened.
    """

    number: int
    name: str
    width: int | None = None
    height: int | None = None
    fps: float | None = None
    opens: bool = True


def find_cameras(devices: Path | None = None) -> list[Camera]:
    """Open every video device for a moment, and return the cameras by number.

    Linux has several devices for one camera, of which only the first delivers images. The others are left out.

    Args:
        devices: Folder in which Linux lists its video devices; `/sys/class/video4linux` if None. Where it does not
            exist, the first numbers are tried.
    """
    devices = devices or LINUX_DEVICES
    if not devices.is_dir():
        return [camera for camera in map(_opened, range(TRIED)) if camera.opens]
    found = ((folder.name.removeprefix("video"), folder) for folder in devices.glob("video*"))
    cameras = []
    for number, folder in sorted((int(number), folder) for number, folder in found if number.isdecimal()):
        camera = _opened(number, _content(folder / "name"))
        if camera.opens or _content(folder / "index") in ("", "0"):
            cameras.append(camera)
    return cameras


def _opened(number: int, name: str = "") -> Camera:
    """Open a camera by its number, and read its image size and rate."""
    import cv2

    with quiet_opencv():
        try:
            capture = cv2.VideoCapture(number)
            if not capture.isOpened():
                return Camera(number, name, opens=False)
            width, height = (round(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            fps = capture.get(cv2.CAP_PROP_FPS)
            capture.release()
        except cv2.error:
            return Camera(number, name, opens=False)
    # OpenCV answers 0 or -1 for what it does not know.
    known = width > 0 and height > 0
    return Camera(number, name, width if known else None, height if known else None, fps if fps > 0 else None)


def _content(file: Path) -> str:
    return file.read_text(errors="replace").strip() if file.is_file() else ""
