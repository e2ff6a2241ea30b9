"""The gate: frames that must not touch the map, because their image or their pose cannot be right."""

from __future__ import annotations

import zlib
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.se3 import inverse_se3, log_se3
from fields.map.keyframes import Keyframe
from pipelines.corrections import WorldMotion
from pipelines.optimise.pose_refinement import pixel_metric
from pipelines.render.renderer import Renderer
from pipelines.settings import GateSettings

__all__ = ["FrameGate"]

# Every how many pixels an image is looked at: a lens cap and a repeated picture are seen anywhere.
STRIDE = 4
# Frames whose motion tells what is usual, and how many there must be.
REMEMBERED, LEAST = 15, 5
# Shorter side [px] of the pyramid level on which the map is asked.
ASKED_SIDE = 60


class FrameGate:
    """Refuses single frames in the midst of a stream.

    `blank`: the image shows nothing. `repeated`: it is that of the frame before, to the bit. `jumped`: the camera is
    said to have moved far more than usual since both the last frame and the last accepted one, and the map looks less
    like the image from there than from where the camera was. A camera that does go elsewhere loses one frame at most.

    refused: how many, by reason.
    """

    def __init__(self, settings: GateSettings) -> None:
        self.settings = settings
        self.refused: dict[str, int] = {"blank": 0, "repeated": 0, "jumped": 0}
        self._picture = 0  # checksum of the last image
        self._seen: tuple[int, NDArray[np.float64]] | None = None
        self._accepted: tuple[int, NDArray[np.float64]] | None = None
        self._motions: deque[float] = deque(maxlen=REMEMBERED)

    def refuses(self, frame: TrackedFrame, last: Keyframe | None, renderer: Renderer, near: float) -> str | None:
        """Why `frame` must not touch the map; None where it may.

        last: the latest keyframe. near: depth below which nothing is drawn. Overwrites the renderer's images.
        """
        if not self.settings.enabled:
            return None
        reason = self._reason(frame, last, renderer, near)
        if reason is not None:
            self.refused[reason] += 1
        return reason

    def _reason(self, frame: TrackedFrame, last: Keyframe | None, renderer: Renderer, near: float) -> str | None:
        glance = frame.rgba[::STRIDE, ::STRIDE]
        picture, self._picture = self._picture, zlib.crc32(np.ascontiguousarray(glance))
        valid = glance[glance[..., 3] > 0][:, :3]
        if len(valid) == 0 or valid.std(axis=0).max() < self.settings.min_contrast:
            return "blank"
        seen, self._seen = self._seen, (frame.index, frame.T_camera_world)
        if picture == self._picture and not np.array_equal(seen[1] if seen else None, frame.T_camera_world):
            return "repeated"
        if last is None or seen is None or self._accepted is None:
            self._accepted = self._seen
            return None
        W = pixel_metric(last)
        motion = min(_motion(W, before, frame) for before in (seen, self._accepted))
        limit = max(
            self.settings.jump * float(np.median(self._motions)) if len(self._motions) >= LEAST else np.inf,
            self.settings.min_jump * float(np.hypot(frame.camera.width, frame.camera.height)),
        )
        if motion > limit and self._map_disagrees(frame, last, renderer, near):
            return "jumped"
        self._motions.append(motion)
        self._accepted = self._seen
        return None

    def _map_disagrees(self, frame: TrackedFrame, last: Keyframe, renderer: Renderer, near: float) -> bool:
        """Whether the image looks more like the map from the last accepted pose than from where it is said to be."""
        level = next((image for image in frame.pyramid[::-1] if _side(image.camera) >= ASKED_SIDE), frame.pyramid[0])
        image, valid = level.rgba[..., :3] / 255.0, level.rgba[..., 3] > 0
        errors = []
        # Refinement has moved the last keyframe's pose against the tracker's; the frame's would be moved alike.
        for T in (self._accepted[1], frame.T_camera_world):
            renderer.forward(level.camera, last.correction @ T, near)
            errors.append(float(np.abs(renderer.images.colour_to_numpy() - image)[valid].mean()))
        return errors[0] < errors[1]

    def correct(self, motion: WorldMotion) -> None:
        """The tracker has revised its poses: those of the frames before as well."""
        self._seen, self._accepted = (
            None if before is None else (before[0], motion.of(*before)[0]) for before in (self._seen, self._accepted)
        )

    # ---- snapshots -------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """What JSON can hold of it, for `restore`."""
        before = [None if b is None else [b[0], b[1].tolist()] for b in (self._seen, self._accepted)]
        return {
            "refused": dict(self.refused),
            "picture": self._picture,
            "before": before,
            "motions": list(self._motions),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Become what `state` was taken of."""
        self.refused |= {name: int(count) for name, count in state["refused"].items()}
        self._picture = int(state["picture"])
        self._seen, self._accepted = (None if b is None else (int(b[0]), np.array(b[1])) for b in state["before"])
        self._motions = deque(map(float, state["motions"]), maxlen=REMEMBERED)


def _motion(W: NDArray[np.float64], before: tuple[int, NDArray[np.float64]], frame: TrackedFrame) -> float:
    """By how many pixels a frame the image has moved since then."""
    moved = np.linalg.solve(W, log_se3(frame.T_camera_world @ inverse_se3(before[1])))
    return float(np.linalg.norm(moved)) / max(frame.index - before[0], 1)


def _side(camera) -> int:
    return min(camera.width, camera.height)
