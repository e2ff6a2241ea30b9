"""What makes a map of frames: the online loop and the offline baseline, as those see them who drive either."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import ClassVar

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from pipelines.corrections import CorrectionReport
from pipelines.optimise.losses import PhotometricLoss
from pipelines.optimise.safeguards import Safeguards
from pipelines.render.renderer import Renderer
from pipelines.settings import RefineSettings
from pipelines.state import MapState
from pipelines.stopwatch import Stopwatch

__all__ = ["FrameReport", "NothingToMapError", "Pipeline"]


class NothingToMapError(ValueError):
    """The frames bring nothing that a map could be made of."""


@dataclass(frozen=True)
class FrameReport:
    """What a frame did to the map. psnr: mean of the last step's views, None where nothing was optimised."""

    index: int
    is_keyframe: bool
    keyframes: int
    gaussians: int
    psnr: float | None


class Pipeline(ABC):
    """Takes in frames one by one and turns them into Gaussians.

    What only the online loop can do has a default here: a map that is made of all frames at once refuses no frame,
    keeps no budget, and cannot be refined or resumed.
    """

    can_be_refined: ClassVar[bool] = False
    """Whether `refine` may follow `finish`."""

    gaussians: GaussianField
    keyframes: KeyframeStore
    renderer: Renderer
    loss: PhotometricLoss
    stopwatch: Stopwatch

    @property
    @abstractmethod
    def near(self) -> float:
        """Depth [scene units] below which nothing is drawn."""

    @abstractmethod
    def compile(self) -> None:
        """Compile every kernel, so that no frame waits for it. The map must be empty."""

    @abstractmethod
    def process(self, frame: TrackedFrame) -> FrameReport:
        """Take in the next frame. Held-out frames must not come here: ValueError."""

    @abstractmethod
    def correct(self, correction: PoseCorrection) -> CorrectionReport:
        """Take over poses and points that the tracker has revised."""

    @abstractmethod
    def finish(self, progress: Callable[[int, int, float], None] | None = None) -> object:
        """Do what follows the last frame.

        Args:
            progress: Of an offline map, see `OfflineMapper.optimise`.

        Raises:
            NothingToMapError: Where there is nothing to start from.
        """

    @abstractmethod
    def caught(self) -> Safeguards:
        """What the safeguards have caught so far. Waits for the device."""

    @property
    def refused(self) -> Mapping[str, int]:
        """How many frames did not touch the map because something is wrong with them, by what."""
        return {}

    def takes_observations(self, count: int) -> bool:
        """Whether there is room to keep so many more of what frames saw of the tracker's points; counted where not."""
        return True

    def count_beside(self, nbytes: int) -> None:  # noqa: B027 - a pipeline without a budget has nothing to count
        """Count so many bytes, which others than the map keep of the frames, in the map's budget."""

    def refine(
        self, settings: RefineSettings, progress: Callable[[int, float], None] | None = None, done: int = 0
    ) -> None:
        """Optimise the finished map for all keyframes alike, see `pipelines.refinement.refine`.

        Raises:
            ValueError: Where it cannot be refined: an offline map has been optimised so from the start.
        """
        raise ValueError("this map cannot be refined")

    def state(self) -> MapState:
        """All that the next frame or step depends on, but for the keyframes' images. Between two steps.

        Raises:
            ValueError: For an offline map.
        """
        raise ValueError("an offline map has no state between two frames")

    def restore(self, state: MapState, frames: Iterable[TrackedFrame]) -> None:
        """Become the pipeline that `state` was taken of. This one must be fresh, and of the same settings.

        Args:
            state: What `state` gave.
            frames: The same as those it had taken in, held-out ones left out: keyframes take their images from them.

        Raises:
            KeyError, TypeError, ValueError: For a state that does not fit, and for an offline map; the pipeline is of
                no use then.
        """
        raise ValueError("an offline map cannot be resumed")
