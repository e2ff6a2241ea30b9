"""Readers of poses and sparse points, one file per kind. Each delivers `TrackedFrame`s in order.

The settings of the kinds are in `modp_ti.config.tracker_settings`. A reader is imported when it is opened, so that a
run loads only the libraries that it needs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from modp_ti.config import tracker_settings as kinds
from modp_ti.config.capture_settings import CaptureSettings
from modp_ti.files.reading import reading
from modp_ti.inputs.protocol import Progress, Tracker

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig

__all__ = ["Progress", "Tracker", "open_tracker"]


def open_tracker(config: SceneConfig, progress: Progress | None = None) -> Tracker:
    """Open the configured tracker. Its input is checked as far as possible without decoding all images.

    Args:
        config: The scene configuration. Only `source`, `tracker` and `seed` are used, and `output` by `sfm`.
        progress: Called while the tracker prepares, for example while it triangulates points.

    Raises:
        InputError: If the input is invalid.

    Example:
        for frame in modp_ti.open_tracker(modp_ti.load_scene("scene.yaml")):
            print(frame.name, len(frame.points))
    """
    of_tracker = dict(config.tracker).get("path")
    with reading(of_tracker or config.source.path or "source.stream"):
        tracker = _opened(config, progress)
    if config.source.part is None:
        return tracker
    from modp_ti.inputs.replay import ReplayedTracker

    assert isinstance(tracker, ReplayedTracker), "SceneConfig refuses parts of other recordings"
    return tracker.within(*config.source.part)


def _opened(config: SceneConfig, progress: Progress | None) -> Tracker:
    """Open the tracker of the whole recording."""
    source = config.source
    match config.tracker:
        case kinds.ColmapSettings() as tracker:
            from modp_ti.inputs.trackers.colmap import open_colmap

            return open_colmap(source, tracker, progress)
        case kinds.TransformsSettings() as tracker:
            from modp_ti.inputs.trackers.transforms import open_transforms

            return open_transforms(source, tracker, progress)
        case kinds.KltSettings() if config.tracks_beside_mapping:
            from modp_ti.inputs.tracking_process import TrackingProcess

            return TrackingProcess(config, progress)
        case kinds.KltSettings() as tracker:
            from modp_ti.inputs.klt import open_klt

            return open_klt(source, tracker, config.seed, progress)
        case kinds.SfmSettings() as tracker:
            from modp_ti.inputs.trackers.sfm import open_sfm

            return open_sfm(source, tracker, config.output / "sfm", config.seed, progress)
        case kinds.TumSettings() as tracker:
            from modp_ti.inputs.trackers.tum import open_tum

            return open_tum(source, tracker, progress)
        case kinds.OrbSlam3Settings() as tracker:
            from modp_ti.inputs.trackers.tum import open_orbslam3

            return open_orbslam3(source, tracker, progress)
        case kinds.StellaVslamSettings() as tracker:
            from modp_ti.inputs.trackers.stella_vslam import open_stella_vslam

            return open_stella_vslam(source, tracker)
        case kinds.AriaSettings() as tracker:
            from modp_ti.inputs.trackers.aria import open_aria

            return open_aria(source, tracker, progress)
        case kinds.ModpSettings() as tracker:
            from modp_ti.inputs.trackers.modp import open_modp

            return open_modp(source, tracker)
        case kinds.ReplicaSettings() as tracker:
            from modp_ti.inputs.trackers.data_sets import open_replica

            return open_replica(source, tracker, progress)
        case kinds.MatricesSettings() as tracker:
            from modp_ti.inputs.trackers.matrices import open_matrices

            return open_matrices(source, tracker, progress)
        case kinds.TanksAndTemplesSettings() as tracker:
            from modp_ti.inputs.trackers.matrices import open_tanksandtemples

            return open_tanksandtemples(source, tracker, progress)
        case kinds.SevenScenesSettings() as tracker:
            from modp_ti.inputs.trackers.data_sets import open_sevenscenes

            return open_sevenscenes(source, tracker, progress)
        case CaptureSettings() as tracker:
            from modp_ti.inputs.trackers.captures import open_capture

            return open_capture(source, tracker, progress)
        case kinds.BagSettings() as tracker:
            from modp_ti.inputs.trackers.bag import open_bag

            return open_bag(source, tracker, progress)
        case kinds.SocketSettings() as tracker:
            from modp_ti.inputs.tracker_server import open_tracker_server

            return open_tracker_server(source, tracker, progress)
