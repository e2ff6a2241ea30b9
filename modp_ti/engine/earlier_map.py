"""`EarlierMap`: the map that a run starts with."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.snapshots.snapshot import StreamDigest
from modp_ti.inputs.protocol import Tracker
from pipelines.settings import RefineSettings


class EarlierMap:
    """The map that a run starts with: an empty one here; subclasses start with that of finished runs."""

    def join(self, tracker: Tracker) -> Tracker:
        """Return the tracker of the run, whose first frames are those of the earlier map.

        Args:
            tracker: The opened tracker of the recording, whose events nobody has taken yet.

        Raises:
            InputError: If the recording does not fit the map.
        """
        return tracker

    def go_on(self, mapper: Mapper, arriving: Iterator[TrackedFrame | PoseCorrection], digest: StreamDigest) -> None:
        """Take the frames of the earlier map from the tracker of the run, and put the map into the mapper.

        Args:
            mapper: A new mapper.
            arriving: The frames of the tracker that `join` has returned.
            digest: Takes what was taken from it.

        Raises:
            InputError: If the map does not fit the settings.
        """

    def recall(self, mapper: Mapper) -> None:
        """Give a restored mapper what it needs of the earlier map beside its own state.

        Args:
            mapper: The mapper of a resumed run.
        """

    def refinement(self, settings: RefineSettings) -> RefineSettings:
        """Return the settings of the refinement of the run's map, given those of the run. Call `join` before."""
        return settings

    @property
    def seconds(self) -> float:
        """Time that the frames of this recording took that are in the earlier map [s]."""
        return 0.0

    @property
    def working(self) -> str:
        """A few words on what `go_on` does, for the progress."""
        return "starting with an empty map"

    @property
    def notes(self) -> list[str]:
        """One-line remarks on the earlier map, for the user. They are available after `join`."""
        return []

    @property
    def metrics(self) -> dict[str, Any]:
        """The entries `onto` and `parts` of `metrics.json`, None without such a map."""
        return {"onto": None, "parts": None}
