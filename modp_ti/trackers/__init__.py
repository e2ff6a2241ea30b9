"""Where poses and sparse points come from: one file per kind, each giving `TrackedFrame`s in order."""

from __future__ import annotations

from typing import TYPE_CHECKING

from modp_ti.trackers.protocol import Progress, Tracker, close, events, frame_count, may_read_ahead

if TYPE_CHECKING:
    from modp_ti.settings import SceneConfig

__all__ = ["Progress", "Tracker", "close", "events", "frame_count", "may_read_ahead", "open_tracker"]


def open_tracker(config: SceneConfig, progress: Progress | None = None) -> Tracker:
    """The tracker that the configuration asks for, its input checked as far as possible without decoding.

    progress: called while a tracker prepares (triangulates). Raises InputError for bad input.
    """
    if config.tracker.kind == "colmap":
        from modp_ti.trackers.colmap import open_colmap

        return open_colmap(config.source, config.tracker)
    if config.tracker.kind == "transforms":
        from modp_ti.trackers.transforms import open_transforms

        return open_transforms(config.source, config.tracker, progress)
    if config.tracker.kind == "tum":
        from modp_ti.trackers.tum import open_tum

        return open_tum(config.source, config.tracker, progress)
    if config.tracker.kind == "orbslam3":
        from modp_ti.trackers.orbslam3 import open_orbslam3

        return open_orbslam3(config.source, config.tracker, progress)
    if config.tracker.kind == "stella_vslam":
        from modp_ti.trackers.stella_vslam import open_stella_vslam

        return open_stella_vslam(config.source, config.tracker)
    if config.tracker.kind == "aria":
        from modp_ti.trackers.aria import open_aria

        return open_aria(config.source, config.tracker, progress)
    if config.tracker.kind == "modp":
        from modp_ti.trackers.modp import open_modp

        return open_modp(config.source, config.tracker)
    if config.tracker.kind == "replica":
        from modp_ti.trackers.replica import open_replica

        return open_replica(config.source, config.tracker, progress)
    if config.tracker.kind == "sevenscenes":
        from modp_ti.trackers.sevenscenes import open_sevenscenes

        return open_sevenscenes(config.source, config.tracker, progress)
    if config.tracker.kind == "socket":
        from modp_ti.trackers.door import open_door

        return open_door(config.source, config.tracker, progress)
    if config.tracker.kind == "klt":
        from modp_ti.trackers.klt import open_klt

        return open_klt(config.source, config.tracker, config.seed, progress)
    from modp_ti.synthetic import open_synthetic

    return open_synthetic(config.source, config.tracker)
