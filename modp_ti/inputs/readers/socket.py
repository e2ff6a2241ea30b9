"""Kind `socket`: another program that sends frames and poses, to `modp_ti.inputs.tracker_server`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field, model_validator

from modp_ti.inputs.protocol import Progress, Tracker
from modp_ti.inputs.reader import TrackerSettings

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import Scene


class SocketSettings(TrackerSettings):
    """Another program that sends frames and poses (docs/tracker_server.md)."""

    needs_source: ClassVar[bool] = False
    brings_cameras: ClassVar[bool] = True
    is_live: ClassVar[bool] = True

    kind: Literal["socket"] = "socket"
    address: str | None = Field(
        default=None, description="host:port of the server; empty: 127.0.0.1:7007, which only this machine can reach"
    )
    path: Path | None = Field(
        default=None,
        description="path of a Unix socket that is created, or of the stream of a killed run; not with `address`",
    )
    patience: float = Field(
        default=120.0, gt=0, description="time [s] without a complete message after which the stream ends"
    )

    @model_validator(mode="after")
    def _listens_at_one_place(self) -> SocketSettings:
        if self.address is not None and self.path is not None:
            raise ValueError("tracker.address and tracker.path cannot both be set; remove one of them")
        return self

    def open(self, scene: Scene, progress: Progress | None = None) -> Tracker:
        """Listen at the address. Frames arrive once a sender has connected."""
        from modp_ti.inputs.tracker_server import TrackerServer

        return TrackerServer(scene.source, self, progress)
