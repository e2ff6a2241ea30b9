"""Shared fixtures and hooks: a fresh engine per test module, test marks, and data shared by modules and workers."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from filelock import FileLock

from fields.runtime.backend import initialise
from fields.runtime.engine import engine, running_program, ti

if TYPE_CHECKING:
    from tests.room import Room, RoomRecording

pytest_plugins = ["tests.spread"]

# The tests use their own kernel cache: the default is limited to 100 MB, which the whole suite exceeds.
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "modp-ti" / "test-kernels"
os.environ.setdefault(engine().variable("offline_cache_file_path"), str(CACHE))
os.environ.setdefault(engine().variable("offline_cache_max_size_of_files"), str(1 << 30))

# Two threads for each of two processes wait for one another. Other numbers of threads are the business of `--spread`.
if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
    share = (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    os.environ.setdefault(engine().variable("cpu_max_num_threads"), str(max(share, 1)))

HERE = Path(__file__).resolve().parent
SHARED_DATA = HERE.parents[1] / "shared" / "data"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests by what they need, and run slow modules first, so that no worker is left with one at the end."""
    for item in items:
        if "shared_data" in getattr(item, "fixturenames", ()):
            item.add_marker("real_data")
        if HERE / "pipelines" / "gpu" in item.path.parents:
            item.add_marker("gpu")
    slow = {item.path for item in items if any(item.iter_markers("slow")) or any(item.iter_markers("gpu"))}
    items.sort(key=lambda item: item.path not in slow)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Report skipped GPU tests, so that such a run is not mistaken for one that tested the GPU's kernels."""
    left_out = [r for r in terminalreporter.getreports("skipped") if "tests/pipelines/gpu/" in r.nodeid]
    if left_out:
        terminalreporter.write_line(
            f"NOT TESTED: the GPU's kernels ({len(left_out)} tests skipped): neither CUDA nor a Vulkan driver starts; "
            "install mesa-vulkan-drivers",
            red=True,
        )


_empty: object | None = None  # the engine's program that has no fields yet, as this file has started it
_finalise = ti.FieldsBuilder._finalize


def _finalised(*arguments: Any, **named: Any) -> Any:
    global _empty
    _empty = None
    return _finalise(*arguments, **named)


ti.FieldsBuilder._finalize = _finalised


@pytest.fixture(autouse=True, scope="module")
def taichi_on_the_cpu() -> None:
    """Free the fields of earlier modules: Taichi 1.7.4 writes out of bounds once fields fill its first GB.

    Most modules make none, and a start takes 0.2 s.
    """
    global _empty
    if _empty is None or _empty is not running_program():
        initialise("cpu")
        _empty = running_program()


@pytest.fixture
def shared_data() -> Callable[[str], Path]:
    """Return a function that gives the folder of a real data set, and skips the test if it is missing."""

    def folder(name: str) -> Path:
        if not (SHARED_DATA / name).is_dir():
            pytest.skip(f"no ../shared/data/{name}")
        return SHARED_DATA / name

    return folder


@pytest.fixture(scope="session")
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], None]], Path]:
    """Return a function that gives a folder by key. The first worker to ask fills it; nobody may change it later."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent

    def folder(key: str, fill: Callable[[Path], None]) -> Path:
        place = base / f"shared-{hashlib.sha256(key.encode()).hexdigest()[:16]}"
        with FileLock(f"{place}.lock"):
            if not (place / "filled").exists():
                (place / "content").mkdir(parents=True)
                fill(place / "content")
                (place / "filled").touch()
        return place / "content"

    return folder


@pytest.fixture(scope="session")
def room() -> Room:
    from tests.room import Room  # imported here because it loads Open3D

    return Room()


@pytest.fixture(scope="session")
def room_recording(room: Room) -> RoomRecording:
    """A recording of nine frames of 80x60 in the room."""
    from tests.room import RoomRecording, pinhole, walk

    return RoomRecording(room, pinhole(80, 60), walk(9))
