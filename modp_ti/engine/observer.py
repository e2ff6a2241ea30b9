"""`Observer`: the base class of objects that are notified while a scene is mapped."""

from __future__ import annotations

from fields.frames.tracked_frame import TrackedFrame
from modp_ti.engine.mapper import Mapper
from modp_ti.outputs.progress import LiveStatus
from pipelines.pipeline import FrameReport


class Observer:
    """Receives events of a run, such as finished frames and steps. This base class ignores them.

    The mapping thread makes the calls and waits for them to return. No other thread may access the map.

    Attributes:
        waited: Total time for which calls held the mapping at a person's request [s]. It does not count as mapping
            time.
    """

    waited = 0.0

    def begin(self, mapper: Mapper, frames: int | None) -> None:
        """Called before the first frame.

        Args:
            mapper: The mapper with its still empty map.
            frames: Number of frames that will come, None if unknown.
        """

    def on_frame(self, frame: TrackedFrame, report: FrameReport | None, live: LiveStatus | None = None) -> None:
        """Called after each frame.

        Args:
            frame: The frame.
            report: What the frame did to the map, None for a held-out frame.
            live: The figures of a realtime run, None for other runs.
        """

    def on_further_step(self) -> None:
        """Called after each step that a realtime run makes while no frame waits."""

    def on_step(self, stage: str, step: int, steps: int | None, psnr: float) -> None:
        """Called after each step of refinement, of offline optimisation or of the passes that finish an online map.

        Args:
            stage: "refining", "optimising" or "settling".
            step: Number of the step, from 1; when settling, of views.
            steps: Total number of them, None if it is not known.
            psnr: Mean PSNR of the step's views [dB].
        """

    def on_stage(self, stage: str) -> None:
        """Called when the map is finished and another stage begins. The map must not be accessed from here on."""
