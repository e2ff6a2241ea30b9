"""Readers, one file per kind: the settings of a kind, how its recordings are recognised, and how they are read.

A file here holds one class derived from `TrackerSettings`, which is all that registers a kind. The files are imported
with the settings: what loads a large library (pycolmap, rosbags, PyTorch) is imported in the function that needs it.
"""

from __future__ import annotations

from importlib import import_module
from inspect import isclass
from pkgutil import iter_modules

from modp_ti.inputs.reader import TrackerSettings, kind_of

__all__ = ["READERS", "SOURCES"]


def _readers() -> dict[str, type[TrackerSettings]]:
    found: dict[str, type[TrackerSettings]] = {}
    for name in sorted(module.name for module in iter_modules(__path__)):
        module = import_module(f"{__name__}.{name}")
        for reader in vars(module).values():
            if isclass(reader) and issubclass(reader, TrackerSettings) and reader.__module__ == module.__name__:
                found[kind_of(reader)] = reader
    return found


READERS = _readers()
"""The readers by `tracker.kind`, in alphabetical order."""

SOURCES = {
    reader.source_kind or kind: reader
    for kind, reader in READERS.items()
    if reader.open_images.__func__ is not TrackerSettings.open_images.__func__
}
"""The readers of images by `source.kind`."""
