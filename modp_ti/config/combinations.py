"""Which settings exclude each other: one table, which a scene is checked against as a whole.

What a single section can decide alone, such as an empty range of frames, is decided by that section's model.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from modp_ti.inputs.reader import GivenPosesSettings

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig

# Names of `used_settings` for frames that do not wait, the most telling first, and for a tracker by what it lacks.
CLOCK = ("source.stream", "source.realtime", "a live tracker", "mapping.pace: realtime")
TRACKED, RECORDED = "a tracker of images as they come", "a tracker of recordings"
CAMERAS, NO_PANORAMAS = "a tracker with cameras", "a tracker without panoramas"

EXCLUSIONS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    (
        "source.stream",
        ("source.path", "source.kind", "source.realtime"),
        "a stream is where the images come from, and always sets the pace",
    ),
    ("source.stream", (RECORDED,), "it needs recorded images; set source.path, or take tracker.kind: klt"),
    ("source.realtime", (RECORDED,), "it does not follow images as they arrive; take tracker.kind: klt"),
    ("source.intrinsics", (CAMERAS,), "it provides the camera of every image"),
    ("tracker.maps", CLOCK[:2], "it needs all images before the first is mapped; record them first"),
    (
        "source.panorama",
        ("source.stream", "source.realtime", "source.intrinsics", "source.masks", "source.vignette"),
        "a panorama is cut into faces, whose cameras are computed",
    ),
    (
        "source.panorama",
        (NO_PANORAMAS,),
        "it has no poses of panoramas; take sfm, transforms, tum, orbslam3, matrices or tanksandtemples",
    ),
    (
        "source.panorama",
        ("tracker.adjust", "onto", "parts", "source.part", CLOCK[-1]),
        "the faces of a panorama keep together, in one map",
    ),
    ("snapshot_every", ("mode: offline", *CLOCK), "a run resumes by reading its frames again; record them"),
    ("onto", ("mode: offline", *CLOCK), "frames wait while they are located in the finished map; record them"),
    ("onto", ("tracker.maps: all",), "one map is continued: set tracker.maps to first, largest or a number"),
    ("onto", ("parts",), "parts make a new map"),
    ("parts", ("source.part",), "the whole recording is cut into parts"),
    *(
        (key, (TRACKED, "mode: offline", *CLOCK), "all poses are needed beforehand; take tracker.kind: sfm")
        for key in ("parts", "source.part")
    ),
)
"""A setting, those that it cannot be combined with, and why, by the names of `used_settings`."""


def used_settings(scene: SceneConfig) -> dict[str, str]:
    """Return the settings of a scene that exclude others: by their names in `EXCLUSIONS`, how the user knows them."""
    source, tracker = scene.source, scene.tracker
    kind = f"tracker.kind: {tracker.kind}"
    maps = getattr(tracker, "maps", "first")
    adjusts = isinstance(tracker, GivenPosesSettings) and tracker.adjusts
    used: dict[str, bool | str] = {
        "source.path": source.path is not None,
        "source.kind": source.kind not in ("auto", "live") and f"source.kind: {source.kind}",
        "source.stream": source.stream is not None,
        "source.realtime": source.realtime,
        "source.intrinsics": source.intrinsics.given,
        "source.masks": source.masks is not None,
        "source.vignette": source.vignette is not None,
        "source.panorama": source.panorama.given,
        "source.part": source.part is not None,
        "tracker.maps": maps != "first" and f"tracker.maps: {maps}",
        "tracker.maps: all": maps == "all",
        "tracker.adjust": adjusts,
        TRACKED: (tracker.follows_streams or tracker.is_live) and kind,
        RECORDED: not tracker.follows_streams and kind,
        CAMERAS: tracker.brings_cameras and kind,
        NO_PANORAMAS: not tracker.places_panoramas and kind,
        "a live tracker": tracker.is_live and kind,
        "mapping.pace: realtime": scene.is_realtime,
        "mode: offline": scene.mode == "offline",
        "snapshot_every": bool(scene.snapshot_every),
        "onto": scene.onto is not None,
        "parts": scene.parts is not None,
    }
    return {name: name if shown is True else shown for name, shown in used.items() if shown}


def refuse_exclusions(scene: SceneConfig) -> None:
    """Raise ValueError for the first two settings of a scene that cannot be combined."""
    used = used_settings(scene)
    for key, others, why in EXCLUSIONS:
        for other in others:
            if key in used and other in used:
                raise ValueError(f"{key} cannot be combined with {used[other]}; remove one of them: {why}")
