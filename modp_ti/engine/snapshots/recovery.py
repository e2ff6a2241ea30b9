"""`Recovery`: where the frames of a live run are kept, for `--resume` after the run was killed."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

from modp_ti.config.scene_file import dump_scene, load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.snapshots.file import FILE as SNAPSHOT
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import list_files
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.readers.socket import SocketSettings
from modp_ti.inputs.sources.frame_store import list_frames

__all__ = ["FILE", "Recovery", "discard", "recovered"]

# Scene file in the output folder, which is there only while a live run goes on, or if it was killed.
FILE = "recording.yaml"
# Beginning of the names of the temporary folders in which live trackers keep what they receive.
KEPT = "modp-ti-"


class Recovery:
    """Writes a scene file of what a live tracker keeps to the output folder, and removes it when the run ends itself.

    Args:
        config: The run's settings.
        tracker: The tracker.
    """

    def __init__(self, config: SceneConfig, tracker: Tracker) -> None:
        self._config = config
        self._tracker = tracker
        self._written = False

    def write(self) -> None:
        """Write the file, if the tracker keeps something. Raises InputError if there is one, or it is unwritable."""
        kept, settings = self._tracker.kept, self._config.without_clock().model_dump(mode="json")
        if self._written or not kept:
            return
        if (self._config.output / FILE).exists():
            raise InputError(
                f"{self._config.output / FILE}: names the frames of a live run that was killed: map them with "
                f"`modp-ti run --resume {self._config.output}`, or delete the file"
            )
        for section, changes in {**kept, "export": {"session": False}}.items():
            settings[section] |= changes
        try:
            self._config.output.mkdir(parents=True, exist_ok=True)
            list_files(self._config.output, [FILE])
            dump_scene(SceneConfig.model_validate(settings, strict=False), self._config.output / FILE)
        except OSError as error:
            raise InputError(f"{self._config.output}: cannot be written: {error.strerror}") from None
        self._written = True

    def remove(self) -> None:
        """Remove the file, as the tracker does with what it keeps."""
        if self._written:
            (self._config.output / FILE).unlink(missing_ok=True)


def recovered(output: Path, overrides: Iterable[str]) -> SceneConfig | None:
    """Return the settings that map what a killed live run has kept; None if there is none, or a later snapshot."""
    file, snapshot = output / FILE, output / SNAPSHOT
    if not file.is_file() or (snapshot.is_file() and snapshot.stat().st_mtime > file.stat().st_mtime):
        return None
    config = load_scene(file, overrides)
    folder = config.source.path
    if folder is not None:
        try:
            list_frames(folder)
        except OSError as error:
            raise InputError(f"{file}: the frames of the recording are not in {folder}: {error.strerror}") from None
    return config


def discard(output: Path) -> None:
    """Delete what a killed live run has kept, after a resumed run has finished its map."""
    file = output / FILE
    if file.is_file():
        config = load_scene(file)
        place = config.tracker.path if isinstance(config.tracker, SocketSettings) else config.source.path
        if place is not None and (folder := place.parent if place.is_file() else place).name.startswith(KEPT):
            shutil.rmtree(folder, ignore_errors=True)
        file.unlink()
