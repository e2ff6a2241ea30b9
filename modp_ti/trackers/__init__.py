"""Where poses and sparse points come from: one file per kind, each giving `TrackedFrame`s in order."""

from __future__ import annotations

from typing import TYPE_CHECKING

from modp_ti.trackers.protocol import Progress, Tracker, events, frame_count, may_read_ahead

if TYPE_CHECKING:
    from modp_ti.config import SceneConfig

__all__ = ["Progress", "Tracker", "events", "frame_count", "may_read_ahead", "open_tracker"]


def open_tracker(config: SceneConfig, progress: Progress | None = None) -> Tracker:
    """The tracker that the configuration asks for, its input checked as far as possible without decoding.

    progress: called while a tracker prepares (the triangulation of `transforms`). Raises InputError for bad
    input.
    """
    if config.tracker.kind == "colmap":
        from modp_ti.trackers.colmap import open_colmap

        return open_colmap(config.source, config.tracker)
    if config.tracker.kind == "transforms":
        from modp_ti.trackers.transforms import open_transforms

        return open_transforms(config.source, config.tracker, progress)
    if config.tracker.kind == "klt":
        from modp_ti.trackers.klt import open_klt

        return open_klt(config.source, config.tracker, config.seed, progress)
    from modp_ti.synthetic import open_synthetic

    return open_synthetic(config.source, config.tracker)
