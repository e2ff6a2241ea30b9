"""Stopping before the end, which saves the map so far; and resuming, from a snapshot or what a killed live run kept."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.keys import as_yaml, differing_keys, leaves
from modp_ti.config.scene_file import dump_scene, load_scene, scene_from_data
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.interruption import RunStopped
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.results import Results
from modp_ti.engine.snapshot import AGAIN, FILE, Checkpointer, Snapshot, StreamDigest, of_another_program
from modp_ti.files.errors import InputError
from modp_ti.files.reading import reading
from modp_ti.files.run_folder import appearing, list_files
from modp_ti.files.storage import Storage
from modp_ti.inputs.protocol import Event, Tracker
from modp_ti.inputs.readers.socket import SocketSettings
from modp_ti.inputs.sources.live import list_frames
from pipelines.companions.block_files import BlockError

# Scene file in the output folder, which is there only while a live run goes on, or if it was killed.
RECORDING = "recording.yaml"
# Beginning of the names of the temporary folders in which live trackers keep what they receive.
KEPT = "modp-ti-"

# Settings that may change on resuming: the map does not depend on them, but for the device, in the last digits.
FREE = (
    "output",
    "force",
    "device",
    "threads",
    "snapshot_every",
    "snapshot_store",
    "source.prefetch",
    "evaluation",
    "export",
    "view",
)


def load_resumed(
    output: Path, scene: Path | None, overrides: Iterable[str], preset: str | None = None
) -> tuple[SceneConfig, Snapshot | None]:
    """Read the snapshot in an output folder and the settings to continue with.

    Args:
        output: The output folder of the interrupted run.
        scene: Scene file to take the settings from, None for those of the snapshot.
        overrides: `KEY=VALUE` settings that override them.
        preset: Preset for the scene file. A snapshot holds every setting, which leaves a preset nothing to set.

    Returns:
        The settings and the snapshot. A killed live run has no snapshot: its frames are mapped from the start.

    Raises:
        InputError: If there is no usable snapshot, or a setting that the map depends on has changed.
    """
    file = output / FILE
    config = None if scene is None else load_scene(scene, overrides, preset)
    if config is not None:
        config = config.model_copy(update={"output": output.resolve()})
        fetch_snapshot(config)
    if not output.is_dir():
        raise InputError(f"{output}: no such folder (--resume); give the output folder of an interrupted run")
    recording = recovered(output, overrides)
    if recording is not None:
        return recording.model_copy(update={"output": output.resolve()}), None
    if not file.is_file():
        if (output / "metrics.json").is_file():
            raise InputError(f"{output}: this run is finished; there is nothing to resume")
        raise InputError(f"{file}: there is no snapshot; start the run from its scene, and set `snapshot_every`")
    snapshot = Snapshot.read(file)
    try:
        scene_from_data(snapshot.settings, str(file))
    except InputError as error:
        raise of_another_program(file, snapshot.program, str(error)) from None
    config = config or scene_from_data(snapshot.settings, str(file), overrides)
    return continued(config.model_copy(update={"output": output.resolve()}), snapshot), snapshot


def continued(config: SceneConfig, snapshot: Snapshot) -> SceneConfig:
    """Return the settings with which a snapshot's run continues, given those of its scene.

    Raises:
        InputError: If a setting that the map depends on has changed.
    """
    before = leaves(snapshot.settings)
    scale = before.get("source.scale")
    if isinstance(scale, float):  # the run's number, which `auto` in the scene file became
        config = config.resolved(scale)
    now = config.model_dump(mode="json")
    after = leaves(now)
    for key in differing_keys(snapshot.settings, now, FREE):
        if key not in before or key not in after:
            raise of_another_program(snapshot.path, snapshot.program, f"only one of them has the setting {key}")
        raise InputError(
            f"{snapshot.path}: the snapshot was made with {key}: {as_yaml(before[key])}, not "
            f"{as_yaml(after[key])}; resume with the settings of the interrupted run"
        )
    return config


def fetch_snapshot(config: SceneConfig) -> None:
    """Put the snapshot of `snapshot_store` into the output folder, unless the one there is of use and as far.

    Raises:
        StorageError: If the storage cannot be read.
        InputError: If the output folder cannot be written.
    """
    if not config.snapshot_store:
        return
    file = config.output / FILE
    with tempfile.TemporaryDirectory(prefix="modp-ti-snapshot-") as folder:
        fetched = Path(folder) / FILE
        if not Storage(config.snapshot_store).get(FILE, fetched):
            return
        if file.is_file() and _progress(fetched, config) <= _progress(file, config):
            return
        with appearing(config.output) as staged:
            shutil.copyfile(fetched, staged / FILE)


def _progress(file: Path, config: SceneConfig) -> tuple[int, bool, int]:
    """Return how far a snapshot is in the run, in an order; before all others if it does not fit the settings."""
    try:
        snapshot = Snapshot.read(file)
        continued(config, snapshot)
    except InputError:
        return -1, False, 0
    return snapshot.position.events, snapshot.position.finished, snapshot.position.refined


def replay(snapshot: Snapshot, mapper: Mapper, arriving: Iterator[Event], digest: StreamDigest) -> None:
    """Read the snapshot's frames from the tracker again, and restore the mapper's state.

    Args:
        snapshot: The snapshot.
        mapper: A new mapper with the snapshot's settings.
        arriving: The tracker's frames and corrections from the start. Those of the snapshot are consumed.
        digest: A new digest. It ends up at the snapshot's position.

    Raises:
        InputError: If the tracker now delivers different data, or the parts of the snapshot do not fit together.
    """
    position = snapshot.position

    def frames() -> Iterator[TrackedFrame]:
        while digest.events < position.events:
            event = next(arriving, None)
            if event is None:
                raise _changed(snapshot, f"it ended after {digest.events} of {position.events} frames")
            digest.add(event)
            if isinstance(event, TrackedFrame) and not event.held_out:
                yield event

    with reading(snapshot.path, AGAIN):
        mapper.restore(snapshot.map, snapshot.frames(mapper.pipeline.trajectory), frames(), position.finished)
        mapper.pipeline.stopwatch.seconds |= {key: snapshot.number("watch", key) for key in snapshot.numbers["watch"]}
    if digest.value != position.digest:
        raise _changed(snapshot, "images, poses or points have changed")


def _changed(snapshot: Snapshot, how: str) -> InputError:
    return InputError(
        f"{snapshot.path}: the input differs from that of the snapshot: {how}; restore the input, or start the run "
        "from its scene"
    )


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
        if (self._config.output / RECORDING).exists():
            raise InputError(
                f"{self._config.output / RECORDING}: names the frames of a live run that was killed: map them with "
                f"`modp-ti run --resume {self._config.output}`, or delete the file"
            )
        for section, changes in {**kept, "export": {"session": False}}.items():
            settings[section] |= changes
        try:
            self._config.output.mkdir(parents=True, exist_ok=True)
            list_files(self._config.output, [RECORDING])
            dump_scene(SceneConfig.model_validate(settings, strict=False), self._config.output / RECORDING)
        except OSError as error:
            raise InputError(f"{self._config.output}: cannot be written: {error.strerror}") from None
        self._written = True

    def remove(self) -> None:
        """Remove the file, as the tracker does with what it keeps."""
        if self._written:
            (self._config.output / RECORDING).unlink(missing_ok=True)


def recovered(output: Path, overrides: Iterable[str]) -> SceneConfig | None:
    """Return the settings that map what a killed live run has kept; None if there is none, or a later snapshot."""
    file, snapshot = output / RECORDING, output / FILE
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
    file = output / RECORDING
    if file.is_file():
        config = load_scene(file)
        place = config.tracker.path if isinstance(config.tracker, SocketSettings) else config.source.path
        if place is not None and (folder := place.parent if place.is_file() else place).name.startswith(KEPT):
            shutil.rmtree(folder, ignore_errors=True)
        file.unlink()


@contextmanager
def saving(mapper: Mapper, keeper: Checkpointer, results: Callable[[], Results]) -> Iterator[None]:
    """Save the map so far if the run stops inside this context, and add to errors how to continue.

    After Ctrl-C, a snapshot and the map are written. If a part of the map on disk is damaged, the map is written
    without it, and the last snapshot stays as it was.

    Args:
        mapper: The mapper.
        keeper: Writes the run's snapshots.
        results: Returns what writes the map to the output folder.

    Raises:
        KeyboardInterrupt: After Ctrl-C, with a message.
        InputError: If a part of the map is damaged.
    """
    output = keeper.path.parent
    try:
        yield
    except RunStopped:
        resumable = keeper.keep() or keeper.usable
        said = f"interrupted after {len(mapper.frames)} frames{_saved(mapper, keeper, results())}"
        raise KeyboardInterrupt(f"{said}; modp-ti run --resume {output} goes on" if resumable else said) from None
    except BlockError as error:
        raise InputError(f"{error}{_saved(mapper, keeper, results())}{keeper.way_on()}") from None
    except Exception as error:
        if way_on := keeper.way_on():
            error.args = (f"{error}{way_on}",)
        raise


def _saved(mapper: Mapper, keeper: Checkpointer, results: Results) -> str:
    """Save the map, and return the part of a message that says where it is, or "" if there is none yet."""
    pipeline = mapper.pipeline
    if not len(pipeline.keyframes):
        return ""
    while True:
        try:
            version = mapper.version()
            break
        except BlockError:
            continue  # without the damaged block, of which there are finitely many
    try:
        with results.writing_map():
            results.write_map(version, pipeline)
    except InputError as error:
        way_on = keeper.way_on() or results.elsewhere(version, pipeline)
        raise InputError(f"{error}{way_on}") from None
    return f"; the map so far is in {keeper.path.parent}"
