"""`Pipeline`: the common interface of the online mapper and the offline baseline."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from numpy.typing import NDArray

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from fields.map.trajectory import Trajectory
from fields.runtime.tenancy import Tenancy
from pipelines.corrections import CorrectionReport
from pipelines.optimise.losses import PhotometricLoss
from pipelines.optimise.safeguards import Safeguards
from pipelines.render.renderer import Renderer
from pipelines.settings import RefineSettings
from pipelines.state import MapState
from pipelines.stopwatch import Stopwatch
from pipelines.transients.sweep import TransientSweep

__all__ = ["FrameReport", "NothingToMapError", "Pipeline"]


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

    Operations that only the online mapper supports have defaults here, which `OfflineMapper` uses: it rejects no frame,
    has no memory budget, and cannot be refined or resumed.
    """

    can_be_refined: ClassVar[bool] = False
    """Whether `refine` may be called after `finish`."""

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
            progress: Callback of an offline map, see `OfflineMapper.optimise`.

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

    def refine(
        self,
        settings: RefineSettings,
        progress: Callable[[int, float], None] | None = None,
        done: int = 0,
        schedule: Callable[[int], float | None] | None = None,
    ) -> None:
        """Optimise the finished map on all keyframes, see `pipelines.refinement.refine`.

        Raises:
            ValueError: If the map cannot be refined: an offline map is optimised on all frames from the start.
        """
        raise ValueError("this map cannot be refined")

    def state(self) -> MapState:
        """Return everything that the next frame or step depends on, except the keyframes' images.

        Call it between two steps.

        Raises:
            ValueError: For an offline map.
        """
        raise ValueError("an offline map has no state between two frames")

    def restore(self, state: MapState, frames: Iterable[TrackedFrame]) -> None:
        """Restore a saved state into a new pipeline with the same settings.

        Args:
            state: Result of `state`.
            frames: The frames that the saved pipeline had processed, without held-out ones. The keyframes take their
                images from them.

        Raises:
            KeyError, TypeError, ValueError: If the state does not fit, and for an offline map. The pipeline is then
                unusable.
        """
        raise ValueError("an offline map cannot be resumed")
