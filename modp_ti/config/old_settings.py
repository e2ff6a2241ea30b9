"""Compatibility with the settings files of older versions.

Until 0.1.0 the `tracker` section had one flat list of keys for all kinds, and a run's `config.yaml` and its snapshots
contained all of them with their defaults. Now each kind has its own keys. A key of another kind is therefore dropped
if its value is empty or the old default, since it never had an effect. With any other value it is reported as an
unknown key, since the user expects it to have an effect.

A kind that was removed is an error that says what replaces it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from modp_ti.config.keys import variants_of
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError

__all__ = ["refuse_removed_kind", "without_leftovers"]

# The keys of the old flat section except `kind`, with their defaults.
FLAT_TRACKER: Mapping[str, Any] = {
    "path": None,
    "points": None,
    "adjust": None,
    "max_points": 2000,
    "max_difference": 0.02,
    "time_offset": 0.0,
    "camera": "camera-rgb",
    "max_inv_dist_std": 0.005,
    "max_dist_std": 0.05,
    "address": None,
    "patience": 120.0,
    "exposure_change": 0.0,
    "drift": 0.0,
    "correction": False,
}

# What to do instead of a tracker that this version no longer has, by kind.
REMOVED_KINDS = {"synthetic": "the procedural room was replaced by demo/room.mp4; map demo/scene.yaml"}

# Every `config.yaml` of 0.2.0 has these keys. What they belonged to is gone.
REMOVED_KEYS = (("mapping", "exposure", "prior"), ("mapping", "optimise", "last_steps"))


def refuse_removed_kind(settings: Mapping[str, Any], where: Mapping[str, str], name: str) -> None:
    """Raise InputError if this version no longer has the scene's `tracker.kind`.

    Args:
        settings: The settings of a scene as plain data.
        where: File and line, or the override, that set each dotted key.
        name: Place to name for keys that are not in `where`.
    """
    tracker = settings.get("tracker")
    if isinstance(tracker, Mapping) and (instead := REMOVED_KINDS.get(str(tracker.get("kind")))):
        place = where.get("tracker.kind", where.get("tracker", name))
        raise InputError(f"{place}: tracker.kind: {tracker['kind']} no longer exists: {instead}")


def without_leftovers(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of a scene's settings without tracker keys of other kinds that are empty or have the old default.

    If the tracker's kind is missing or unknown, all keys are kept.
    """
    for names in REMOVED_KEYS:
        settings = _without_removed(settings, names)
    tracker = settings.get("tracker")
    kind = tracker.get("kind") if isinstance(tracker, Mapping) else None
    model = variants_of(SceneConfig.model_fields["tracker"]).get(str(kind))
    if model is None or not isinstance(tracker, Mapping):
        return dict(settings)

    def says_something(key: str, value: Any) -> bool:
        return key in model.model_fields or key not in FLAT_TRACKER or value not in (None, FLAT_TRACKER[key])

    return {**settings, "tracker": {key: value for key, value in tracker.items() if says_something(key, value)}}


def _without_removed(settings: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Return a copy of settings without the removed key, whose sections may be absent."""
    name, *deeper = names
    if not deeper:
        return {key: value for key, value in settings.items() if key != name}
    section = settings.get(name)
    return {**settings, name: _without_removed(section, deeper)} if isinstance(section, Mapping) else dict(settings)
