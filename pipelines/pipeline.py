"""`Pipeline`: the common interface of the online mapper and the offline baseline, and the time of its stages."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from fields.runtime.tenancy import in_engine

if TYPE_CHECKING:
    from fields.frames.pose_correction import PoseCorrection
    from fields.frames.tracked_frame import TrackedFrame
    from fields.map.gaussians import GaussianField
    from fields.map.keyframes import KeyframeStore
    from fields.map.trajectory import Trajectory
    from fields.runtime.tenancy import Tenancy
    from pipelines.companions.transients import TransientSweep
    from pipelines.corrections import CorrectionReport
    from pipelines.render.renderer import LossStage, Renderer
    from pipelines.safeguards import Safeguards


class NothingToMapError(ValueError):
    """Raised if the frames contain nothing that a map could be built from."""


@dataclass(frozen=True)
class FrameReport:
    """Result of processing one frame.

    Attributes:
        index: Index of the frame.
        is_keyframe: Whether the frame became a keyframe.
        keyframes: Number of keyframes.
        gaussians: Number of Gaussians.
        psnr: Mean PSNR of the last step's views [dB]; None if nothing was optimised.
        steps: Number of optimisation steps that it got.
    """

    index: int
    is_keyframe: bool
    keyframes: int
    gaussians: int
    psnr: float | None
    steps: int = 0


@in_engine("caught")
class Pipeline(ABC):
    """Builds a map of Gaussians from frames that are processed one by one.

    What only the online mapper does has defaults here, for `OfflineMapper`: it rejects no frame and has no budget.

    Attributes:
        transients: Masks what moves; None if it is not masked.
    """

    settings: Any
    gaussians: GaussianField
    keyframes: KeyframeStore
    trajectory: Trajectory
    renderer: Renderer
    loss: LossStage
    safeguards: Safeguards
    stopwatch: Stopwatch
    tenancy: Tenancy
    transients: TransientSweep | None = None

    @property
    def near(self) -> float:
        """Depth [scene units] below which nothing is drawn."""
        return self.settings.near * self.keyframes.scene_depth

    @property
    def gaussian_count(self) -> int:
        """Number of Gaussians of the whole map."""
        return len(self.gaussians)

    def all_gaussians(self) -> dict[str, NDArray]:
        """Return the values of the whole map, with the names and shapes of `GaussianField.to_numpy`."""
        return self.gaussians.to_numpy()

    @abstractmethod
    def compile(self) -> None:
        """Compile all kernels ahead of the first frame. The map must be empty."""

    @abstractmethod
    def process(self, frame: TrackedFrame) -> FrameReport:
        """Process the next frame.

        Raises:
            ValueError: If the frame is held out for evaluation.
        """

    def _refuse_held_out(self, frame: TrackedFrame) -> None:
        if frame.held_out:
            raise ValueError(f"frame {frame.index} is held out for evaluation and must not touch the map")

    @abstractmethod
    def correct(self, correction: PoseCorrection, more: bool = False) -> CorrectionReport:
        """Apply revised poses and points. With `more`, the Gaussians wait for another correction, and move with it."""

    @abstractmethod
    def finish(self, progress: Callable[[int, int, float], None] | None = None) -> object:
        """Finish the map after the last frame.

        Args:
            progress: Callback of the steps, see `pipelines.refinement.finish` and `OfflineMapper.optimise`.

        Raises:
            NothingToMapError: If there are no points to start from.
        """

    def caught(self) -> Safeguards:
        """Return the safeguards' counts so far. Waits for the device."""
        steps, exploded = self.gaussians.take_caught()
        self.safeguards.gaussian_steps += steps
        self.safeguards.exploded_gaussians += exploded
        return self.safeguards

    @property
    def refused(self) -> Mapping[str, int]:
        """Number of frames that were rejected as implausible, by reason."""
        return {}

    def takes_observations(self, count: int) -> bool:
        """Whether the budget has room for `count` more observations of tracked points. Rejections are counted."""
        return True

    def count_beside(self, nbytes: int) -> None:  # noqa: B027 - a pipeline without a budget has nothing to count
        """Set the bytes that are kept outside the map and count towards its memory budget."""


# The stages of the paper's breakdown: Optim, Cam Select, Depth Est., MOHV.
BREAKDOWN = ("optimise", "select", "depth", "occupancy")


class Stopwatch:
    """Accumulates wall-clock time by stage.

    Attributes:
        seconds: Time of each stage [s].
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Context manager that adds the time of its block to `stage`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


def breakdown_percent(seconds: Mapping[str, float], total: float) -> dict[str, float]:
    """Return the stages' percentages of a total time [s], as in the paper's breakdown, and the rest as `others`."""
    percent = {stage: 100.0 * seconds.get(stage, 0.0) / total for stage in BREAKDOWN}
    percent["others"] = 100.0 - sum(percent.values())
    return {stage: round(value, 2) for stage, value in percent.items()}
