"""Registry of trackers: maps the settings class of each kind to its opener.

Openers import their reader when called, so that a run loads only the libraries that it needs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from modp_ti.config.settings import SourceSettings
from modp_ti.config.tracker_settings import (
    AriaSettings,
    ColmapSettings,
    KltSettings,
    ModpSettings,
    OrbSlam3Settings,
    ReplicaSettings,
    SevenScenesSettings,
    SocketSettings,
    StellaVslamSettings,
    TrackerSettings,
    TransformsSettings,
    TumSettings,
)
from modp_ti.inputs.protocol import Progress, Tracker

__all__ = ["OPENERS", "Opening", "opens"]


@dataclass(frozen=True)
class Opening:
    """Arguments of an opener besides the tracker's own settings.

    Attributes:
        source: Settings of the images.
        seed: Random seed.
        progress: Called while the tracker prepares.
    """

    source: SourceSettings
    seed: int = 0
    progress: Progress | None = None


S = TypeVar("S", bound=TrackerSettings)

OPENERS: dict[type[TrackerSettings], Callable[[Any, Opening], Tracker]] = {}
"""Openers by settings class. An opener checks its input as far as possible without decoding all images."""


def opens(settings: type[S]) -> Callable[[Callable[[S, Opening], Tracker]], Callable[[S, Opening], Tracker]]:
    """Register the decorated function as the opener for this settings class."""

    def register(opener: Callable[[S, Opening], Tracker]) -> Callable[[S, Opening], Tracker]:
        OPENERS[settings] = opener
        return opener

    return register


@opens(ColmapSettings)
def _(tracker: ColmapSettings, opening: Opening) -> Tracker:
    from modp_ti.inputs.trackers.colmap import open_colmap

    return open_colmap(opening.source, tracker)


@opens(TransformsSettings)
def _(tracker: TransformsSettings, opening: Opening) -> Tracker:
    from modp_ti.inputs.trackers.transforms import open_transforms

    return open_transforms(opening.source, tracker, opening.progress)


@opens(KltSettings)
def _(_: KltSettings, opening: Opening) -> Tracker:
    from modp_ti.inputs.klt import open_klt

    return open_klt(opening.source, opening.seed, opening.progress)


@opens(TumSettings)
def _(tracker: TumSettings, opening: Opening) -> Tracker:
    from modp_ti.inputs.trackers.tum import open_tum

    return open_tum(opening.source, tracker, opening.progress)


@opens(OrbSlam3Settings)
def _(tracker: OrbSlam3Settings, opening: Opening) -> Tracker:
    from modp_ti.inputs.trackers.orbslam3 import open_orbslam3

    return open_orbslam3(opening.source, tracker, opening.progress)


@opens(StellaVslamSettings)
def _(tracker: StellaVslamSettings, opening: Opening) -> Tracker:
    from modp_ti.inputs.trackers.stella_vslam import open_stella_vslam

    return open_stella_vslam(opening.source, tracker)


@opens(AriaSettings)
def _(tracker: AriaSettings, opening: Opening) -> Tracker:
    from modp_ti.inputs.trackers.aria import open_aria

    return open_aria(opening.source, tracker, opening.progress)


@opens(ModpSettings)
def _(tracker: ModpSettings, opening: Opening) -> Tracker:
    from modp_ti.inputs.trackers.modp import open_modp

    return open_modp(opening.source, tracker)


@opens(ReplicaSettings)
def _(tracker: ReplicaSettings, opening: Opening) -> Tracker:
    from modp_ti.inputs.trackers.replica import open_replica

    return open_replica(opening.source, tracker, opening.progress)


@opens(SevenScenesSettings)
def _(tracker: SevenScenesSettings, opening: Opening) -> Tracker:
    from modp_ti.inputs.trackers.sevenscenes import open_sevenscenes

    return open_sevenscenes(opening.source, tracker, opening.progress)


@opens(SocketSettings)
def _(tracker: SocketSettings, opening: Opening) -> Tracker:
    from modp_ti.inputs.tracker_server import open_tracker_server

    return open_tracker_server(opening.source, tracker, opening.progress)
