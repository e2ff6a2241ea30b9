"""`FrameGate`: rejects frames that cannot be right, and `sharpness`, how sharp an image is."""

from __future__ import annotations

import zlib
from collections import deque
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera, pixel_metric
from fields.geometry.se3 import inverse_se3, log_se3
from fields.map.keyframe import Keyframe
from fields.map.trajectory import Trajectory
from pipelines.settings import GateSettings

if TYPE_CHECKING:  # `modp-ti check` measures sharpness without loading PyTorch
    from pipelines.render.renderer import Renderer


def sharpness(rgb: NDArray[np.uint8]) -> float:
    """Ratio of the detail of an image (H, W, 3 or more channels) to the detail of its half-size version.

    Detail is the mean absolute second difference along rows, columns and both diagonals. The smallest of the four
    ratios is used, because motion blurs along one direction only. It is about 0.5 to 0.7 for a photograph, a quarter
    less after a blur over two pixels, and 0 without any detail or with a side shorter than 6 pixels.
    """
    if min(rgb.shape[:2]) < 6:
        return 0.0
    full = cv2.cvtColor(np.ascontiguousarray(rgb[..., :3]), cv2.COLOR_RGB2GRAY).astype(np.float32)
    half = cv2.resize(full, (full.shape[1] // 2, full.shape[0] // 2), interpolation=cv2.INTER_AREA).astype(np.float32)
    fine, coarse = _detail(full), _detail(half)
    return float((fine / coarse).min()) if coarse.min() > 0 else 0.0


def _detail(grey: NDArray[np.float32]) -> NDArray[np.float64]:
    """Mean absolute second difference (4,) along a row, a column and the two diagonals."""
    height, width = grey.shape
    centre = 2.0 * grey[1:-1, 1:-1]

    def difference(dy: int, dx: int) -> float:
        ahead = grey[1 + dy : height - 1 + dy, 1 + dx : width - 1 + dx]
        behind = grey[1 - dy : height - 1 - dy, 1 - dx : width - 1 - dx]
        return float(np.abs(centre - ahead - behind).mean())

    return np.array([difference(0, 1), difference(1, 0), difference(1, 1), difference(1, -1)])


# Pixel stride of the checks on the image. A covered lens or a repeated image shows at any resolution.
STRIDE = 4
# The usual motion is the median over the last `REMEMBERED` frames, once there are `LEAST`.
REMEMBERED, LEAST = 15, 5
# Minimum shorter side [px] of the pyramid level that is compared with the map.
ASKED_SIDE = 60


class FrameGate:
    """Rejects single implausible frames of a stream.

    A frame is rejected for one of three reasons:

    - `blank`: the valid pixels have almost no contrast.
    - `repeated`: the image equals that of the previous frame, while the pose differs.
    - `jumped`: the camera moved far more than usual since both the previous and the last accepted frame, and the
      render of the map at the new pose matches the image less well than the render at the last accepted pose. A
      camera that does move elsewhere loses at most one frame.

    Attributes:
        refused: Number of rejected frames by reason.
    """

    def __init__(self, settings: GateSettings, trajectory: Trajectory) -> None:
        self.settings = settings
        self.trajectory = trajectory
        self.refused: dict[str, int] = {"blank": 0, "repeated": 0, "jumped": 0}
        self._picture = 0  # checksum of the last image
        # Frame indices of the previous and the last accepted frame.
        self._seen: int | None = None
        self._accepted: int | None = None
        self._motions: deque[float] = deque(maxlen=REMEMBERED)

    def refuses(self, frame: TrackedFrame, last: Keyframe | None, renderer: Renderer, near: float) -> str | None:
        """Return why `frame` is rejected. Overwrites the renderer's images.

        Args:
            frame: The frame to check.
            last: The latest keyframe; None if there is none.
            renderer: Renderer of the map.
            near: Depth below which nothing is drawn [scene units].

        Returns:
            `"blank"`, `"repeated"` or `"jumped"`; None if the frame is accepted.
        """
        if not self.settings.enabled:
            return None
        reason = self._reason(frame, last, renderer, near)
        if reason is not None:
            self.refused[reason] += 1
        return reason

    def _reason(self, frame: TrackedFrame, last: Keyframe | None, renderer: Renderer, near: float) -> str | None:
        glance = frame.rgba[::STRIDE, ::STRIDE]
        picture, self._picture = self._picture, zlib.crc32(np.ascontiguousarray(glance).data)
        valid = glance[glance[..., 3] > 0][:, :3]
        if len(valid) == 0 or valid.std(axis=0).max() < self.settings.min_contrast:
            return "blank"
        seen, self._seen = self._seen, frame.index
        if picture == self._picture and (
            seen is None or not np.array_equal(self.trajectory[seen], frame.T_camera_world)
        ):
            return "repeated"
        if last is None or seen is None or self._accepted is None:
            self._accepted = self._seen
            return None
        W = pixel_metric(last.camera, last.median_depth)
        motion = min(_motion(W, before, self.trajectory[before], frame) for before in (seen, self._accepted))
        limit = max(
            self.settings.jump * float(np.median(self._motions)) if len(self._motions) >= LEAST else np.inf,
            self.settings.min_jump * float(np.hypot(frame.camera.width, frame.camera.height)),
        )
        if motion > limit and _map_disagrees(frame, last, self.trajectory[self._accepted], renderer, near):
            return "jumped"
        self._motions.append(motion)
        self._accepted = self._seen
        return None

    # ---- snapshots -------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Return the state as JSON-compatible values, for `restore`."""
        return {
            "refused": dict(self.refused),
            "picture": self._picture,
            "before": [self._seen, self._accepted],
            "motions": list(self._motions),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the result of `state`."""
        self.refused |= {name: int(count) for name, count in state["refused"].items()}
        self._picture = int(state["picture"])
        self._seen, self._accepted = (None if b is None else int(b) for b in state["before"])
        self._motions = deque(map(float, state["motions"]), maxlen=REMEMBERED)


def _motion(W: NDArray[np.float64], index: int, T_camera_world: NDArray[np.float64], frame: TrackedFrame) -> float:
    """Image motion [px per frame] from frame `index` at `T_camera_world` (4, 4) to a later `frame`."""
    moved = np.linalg.solve(W, log_se3(frame.T_camera_world @ inverse_se3(T_camera_world)))
    return float(np.linalg.norm(moved)) / max(frame.index - index, 1)


def _map_disagrees(
    frame: TrackedFrame, last: Keyframe, T_accepted: NDArray[np.float64], renderer: Renderer, near: float
) -> bool:
    """Whether the image matches the map better from the last accepted pose than from the frame's own pose."""
    level = next((image for image in frame.pyramid[::-1] if _side(image.camera) >= ASKED_SIDE), frame.pyramid[0])
    image, valid = level.rgba[..., :3] / 255.0, level.rgba[..., 3] > 0
    errors = []
    # The last keyframe's refinement is applied to both tracked poses, as it would be to a new keyframe.
    for T in (T_accepted, frame.T_camera_world):
        renderer.forward(level.camera, last.correction @ T, near)
        errors.append(float(np.abs(renderer.images.colour_to_numpy() - image)[valid].mean()))
    return errors[0] < errors[1]


def _side(camera: PinholeCamera) -> int:
    return min(camera.width, camera.height)
