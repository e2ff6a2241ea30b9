"""`Pipeline`: the common interface of the online mapper and the offline baseline."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from fields.map.trajectory import Trajectory
from fields.runtime.tenancy import Tenancy
from pipelines.companions.transients import TransientSweep
from pipelines.corrections import CorrectionReport
from pipelines.optimise.losses import PhotometricLoss
from pipelines.optimise.safeguards import Safeguards
from pipelines.render.renderer import Renderer
from pipelines.stopwatch import Stopwatch


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


class Pipeline(ABC):
    """Builds a map of Gaussians from frames that are processed one by one.

    What only the online mapper does has defaults here, for `OfflineMapper`: it rejects no frame and has no budget.
    """

    gaussians: GaussianField
    keyframes: KeyframeStore
    trajectory: Trajectory
    renderer: Renderer
    loss: PhotometricLoss
    stopwatch: Stopwatch
    tenancy: Tenancy
    transients: TransientSweep | None = None
    """Masks what moves; None if it is not masked."""

    @property
    @abstractmethod
    def near(self) -> float:
        """Depth [scene units] below which nothing is drawn."""

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

    @abstractmethod
    def correct(self, correction: PoseCorrection, more: bool = False) -> CorrectionReport:
        """Apply poses and points that the tracker has revised.

        Args:
            correction: The revised poses and points.
            more: Whether another correction follows at once, with which the Gaussians then move.
        """

    @abstractmethod
    def finish(self, progress: Callable[[int, int, float], None] | None = None) -> object:
        """Finish the map after the last frame.

        Args:
            progress: Callback of the steps, see `pipelines.refinement.finish` and `OfflineMapper.optimise`.

        Raises:
            NothingToMapError: If there are no points to start from.
        """

    @abstractmethod
    def caught(self) -> Safeguards:
        """Return the safeguards' counts so far. Waits for the device."""

    @property
    def refused(self) -> Mapping[str, int]:
        """Number of frames that were rejected as implausible, by reason."""
        return {}

    def takes_observations(self, count: int) -> bool:
        """Whether the budget has room for `count` more observations of tracked points. Rejections are counted."""
        return True

    def count_beside(self, nbytes: int) -> None:  # noqa: B027 - a pipeline without a budget has nothing to count
        """Set the bytes that are kept outside the map and count towards its memory budget."""
