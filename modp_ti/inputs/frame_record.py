"""`FrameRecord`: a tracked frame without its picture, which is kept or sent next to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from modp_ti.inputs.sources import Picture


@dataclass(frozen=True)
class FrameRecord:
    """A `TrackedFrame` without its image, mask, vignette and camera. The attributes are those of the frame."""

    index: int
    timestamp: float
    name: str
    T_camera_world: NDArray[np.float64]
    points: SparsePoints
    held_out: bool = False
    arrived: float | None = None
    views: int = 1

    @classmethod
    def of(cls, frame: TrackedFrame) -> FrameRecord:
        return cls(**{field.name: getattr(frame, field.name) for field in fields(cls)})

    def with_picture(self, picture: Picture) -> TrackedFrame:
        """Return the frame with its picture."""
        return TrackedFrame(**vars(self), **vars(picture))

    def arrays(self) -> dict[str, NDArray]:
        """Return the record as arrays of numbers and text, for `of_arrays`."""
        points, plain = self.points, {name: value for name, value in vars(self).items() if name != "points"}
        plain["arrived"] = np.nan if self.arrived is None else self.arrived
        arrays = {name: np.asarray(value) for name, value in plain.items()}
        return arrays | {"xyz": points.xyz, "pixels": points.pixels, "ids": points.ids}

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray]) -> FrameRecord:
        """Return the record of these arrays, among which there may be others."""
        arrived = float(arrays["arrived"])
        return cls(
            index=int(arrays["index"]),
            timestamp=float(arrays["timestamp"]),
            name=str(arrays["name"]),
            T_camera_world=arrays["T_camera_world"],
            points=SparsePoints(arrays["xyz"], arrays["pixels"], arrays["ids"]),
            held_out=bool(arrays["held_out"]),
            arrived=None if np.isnan(arrived) else arrived,
            views=int(arrays["views"]),
        )
