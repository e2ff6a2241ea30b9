"""Tasks: `modp-ti run --task` in a separate process, seen from outside and from within; and what it leaves."""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from enum import Enum
from pathlib import Path
from typing import Any

from modp_ti.config.scene_file import load_scene, scene_from_data
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from modp_ti.files.processes import child_environment
from modp_ti.files.run_folder import appearing, sole_use
from modp_ti.files.storage import Storage, StorageError
from modp_ti.outputs.playback.finished_run import METRICS, SETTINGS, finished_metrics, made_with
from modp_ti.outputs.progress import StageProgress

# Folder of the finished run's files within the scene's storage.
OUTPUT = "output"
# Time that a task gets to save what it has when it is to end, or when the process that began it is gone [s].
PATIENCE = 60.0
# Time between two lines of progress in the log of a task [s].
LOG_EVERY = 5.0
# Exit codes of `modp-ti run`, see docs/commands.md.
BAD_INPUT, INTERRUPTED = 2, (129, 130, 143)


class End(str, Enum):
    """How a task ended."""

    done = "done"
    failed = "failed"
    """Its input cannot be used: another attempt would fail too."""
    fault = "fault"
    """A fault of the program."""
    interrupted = "interrupted"
    lost = "lost"
    """Its process or its machine ended before the run did: another attempt may succeed."""


class TaskProcess:
    """The process of a task. It saves what it has and ends when its standard input ends, as it does with this process.

    Args:
        settings: Settings of the scene as plain data, with absolute paths.
        cpus: Cores for it.
        log: File that what it prints is appended to.
    """

    def __init__(self, settings: dict[str, Any], cpus: float, log: Path) -> None:
        self._log, self._size = log, 0
        self._answer = tempfile.TemporaryFile()
        log.parent.mkdir(parents=True, exist_ok=True)
        with open(log, "ab", opener=_not_through_links) as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "modp_ti.run", "--task", "--json"],
                env=child_environment(max(1, int(cpus))),
                stdin=subprocess.PIPE,
                stdout=self._answer,
                stderr=output,
                start_new_session=True,  # Ctrl-C is for this process, which decides what it means
            )
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(settings).encode() + b"\n")
            self._process.stdin.flush()
        except OSError:
            pass  # the process is gone, as `end` finds

    def end(self, wait: float = 0.0) -> tuple[End, str] | None:
        """Return how the task has ended, with one line that says why; None if it has not within `wait` seconds."""
        try:
            code = self._process.wait(wait)
        except subprocess.TimeoutExpired:
            return None
        self._answer.seek(0)
        try:
            answer = json.loads(self._answer.read())
        except ValueError:
            answer = {}
        if code == 0:
            return End.done, ""
        if code in INTERRUPTED:
            return End.interrupted, "interrupted"
        if not answer:
            return End.lost, f"its process ended ({_cause(code)})"
        if code == BAD_INPUT:
            return End.failed, answer["error"]
        return End.fault, f"{answer['error']}: its log has the traceback"

    def news(self) -> str:
        """Return the last line of the log if there is more in it than before, else an empty text."""
        size = self._log.stat().st_size
        if size == self._size:
            return ""
        self._size = size
        lines = log_end(self._log, 4096).decode(errors="replace").splitlines()
        return lines[-1] if lines else ""

    def stop(self) -> None:
        """Have the task save what it has and end."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.close()
        except OSError:
            pass  # the process is gone

    def close(self) -> None:
        """Kill the process if it still runs."""
        self._process.kill()
        self._process.wait()
        self.stop()
        self._answer.close()


def log_end(log: Path, most: int) -> bytes:
    """Return the last bytes of a file, at most so many."""
    with open(log, "rb") as file:
        file.seek(-min(most, log.stat().st_size), os.SEEK_END)
        return file.read()


def _cause(code: int) -> str:
    if code >= 0:
        return f"exit code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    return f"{name}, perhaps for want of memory" if -code == signal.SIGKILL else name


def _not_through_links(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o666)


# ---- within the process ----------------------------------------------------------------------------------------------


def carry_out(console: Any) -> Path:
    """Map the scene whose settings standard input holds as one line of JSON, and return its output folder.

    A run that an earlier attempt has finished is not repeated, and one that it has begun continues from its last
    snapshot: that of the output folder or of `snapshot_store`, whichever is further. A snapshot that does not fit the
    settings is left aside. With `snapshot_store`, the output files are copied there as well.

    Args:
        console: Receives progress and notes.

    Raises:
        InputError: If the input cannot be used.
        KeyboardInterrupt: When standard input ends; the run is saved first, as after Ctrl-C.
    """
    from modp_ti.engine.resume import continued, fetch_snapshot
    from modp_ti.engine.session import run_scene
    from modp_ti.engine.snapshot import FILE, Snapshot

    with open(0, "rb", buffering=0, closefd=False) as given:
        config = scene_from_data(json.loads(given.readline()), "the scene")
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    logged = 0.0

    def say(note: str) -> None:
        console.print(f"note: {note}", highlight=False, soft_wrap=True)

    def watch(progress: StageProgress) -> None:
        nonlocal logged
        if time.monotonic() - logged >= LOG_EVERY:
            logged = time.monotonic()
            console.print(str(progress), highlight=False, soft_wrap=True)

    with sole_use(config.output):
        if finished_metrics(config) is None:
            try:
                fetch_snapshot(config)
            except StorageError as error:
                say(str(error))
            snapshot = None
            if (config.output / FILE).is_file():
                try:
                    snapshot = Snapshot.read(config.output / FILE)
                    config = continued(config, snapshot)
                except InputError as error:
                    snapshot = None
                    say(f"started from the first frame: {error}")
            run_scene(config, console, snapshot, watch=watch)
        if finished_metrics(config) is None:
            raise InputError(f"{config.output}: the run has left no metrics.json that can be read; run it again")
        if config.snapshot_store:
            try:
                Storage(config.snapshot_store).within(OUTPUT).put_folder(config.output)
            except StorageError as error:
                raise InputError(f"{error}; the map is in {config.output} on {platform.node()}") from None
    return config.output


def _end_with_parent() -> None:
    """Interrupt the run, as SIGTERM does, when standard input ends. End the process if it does not in time."""
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    threading.Event().wait(PATIENCE)
    os._exit(1)


# ---- what it leaves --------------------------------------------------------------------------------------------------


def fetch_finished(config: SceneConfig) -> bool:
    """Copy the files of a finished run from `snapshot_store` to the output folder, unless it has them already.

    Returns:
        Whether the output folder now holds a finished run of these settings.

    Raises:
        InputError: If the storage cannot be read, or the output folder not be written.
    """
    if finished_metrics(config) is None and config.snapshot_store:
        storage = Storage(config.snapshot_store).within(OUTPUT)
        with tempfile.TemporaryDirectory(prefix="modp-ti-batch-") as folder:
            file = Path(folder) / SETTINGS
            try:
                stored = storage.has(METRICS) and storage.get(SETTINGS, file) and made_with(load_scene(file), config)
            except StorageError:
                raise
            except InputError:
                stored = False
        if stored:
            with appearing(config.output) as staged:
                storage.get_folder(staged)
    return finished_metrics(config) is not None
