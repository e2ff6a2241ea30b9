"""Resuming a run: find its snapshot and settings, and read again the frames that the snapshot was made from."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.config.keys import as_yaml, differing_keys, leaves
from modp_ti.config.scene_file import load_scene, scene_from_data
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.snapshots.file import FILE, of_another_program
from modp_ti.engine.snapshots.recovery import recovered
from modp_ti.engine.snapshots.snapshot import Snapshot, StreamDigest
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing
from modp_ti.files.storage import Storage

__all__ = ["continued", "fetch_snapshot", "load_resumed", "replay"]

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


def replay(
    snapshot: Snapshot, mapper: Mapper, arriving: Iterator[TrackedFrame | PoseCorrection], digest: StreamDigest
) -> None:
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

    with snapshot.fitting():
        mapper.restore(snapshot.map, snapshot.frames(mapper.pipeline.trajectory), frames(), position.finished)
        mapper.pipeline.stopwatch.seconds |= {key: snapshot.number("watch", key) for key in snapshot.numbers["watch"]}
    if digest.value != position.digest:
        raise _changed(snapshot, "images, poses or points have changed")


def _changed(snapshot: Snapshot, how: str) -> InputError:
    return InputError(
        f"{snapshot.path}: the input differs from that of the snapshot: {how}; restore the input, or start the run "
        "from its scene"
    )
