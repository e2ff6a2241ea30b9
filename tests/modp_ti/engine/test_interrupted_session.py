"""Ctrl-C and full disks in a live session: what came so far is saved, and one line says where."""

from __future__ import annotations

import errno
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.engine import results, session, stages
from modp_ti.engine.resume import load_resumed
from modp_ti.engine.stream import Observer
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing
from modp_ti.outputs.formats.splats_ply import read_splats
from tests.modp_ti.engine.stopped_runs import Stopper, press_ctrl_c
from tests.room import Room, RoomRecording, pinhole, walk

SAVED = {".modp-ti", "splats.ply", "trajectory.txt", "frames.json", "colmap", "config.yaml"}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory, room: Room) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    RoomRecording(room, pinhole(160, 120), walk(40)).write(folder)
    return folder


@pytest.fixture
def scene(tmp_path: Path, recording: Path) -> Path:
    """A walk that is played at its own pace, as a camera would."""
    camera = pinhole(160, 120)
    (tmp_path / "images").symlink_to(recording / "images")
    file = tmp_path / "scene.yaml"
    file.write_text(f"""
source:  {{path: images, realtime: true, fps: 20, intrinsics: {{fx: {camera.fx}, fy: {camera.fy}, cx: 80, cy: 60}}}}
tracker: {{kind: klt}}
output:  out
device:  cpu
refine:  {{seconds: 600}}
export:  {{report: false}}
""")
    return file


@pytest.fixture
def in_a_terminal():
    """Where the tests run in a shell's background, Ctrl-C is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.signal(signal.SIGINT, before) is signal.default_int_handler, "the run gave Ctrl-C back"


class Pressed(Stopper):
    """Presses Ctrl-C at the fifth frame, which may end the recording, and at the seventh, while mapping."""

    def on_frame(self, *_: object) -> None:
        self.frames = getattr(self, "frames", 0) + 1
        if self._stage == "mapping" and self.frames in (5, 7):
            press_ctrl_c()


@pytest.mark.usefixtures("in_a_terminal")
@pytest.mark.parametrize("stage", ["mapping", "refining"])
def test_ctrl_c_after_the_recording_has_ended_saves_the_map_so_far(
    stage: str, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stages, "open_observer", lambda *_: Pressed(stage, 2, press_ctrl_c))
    out = scene.parent / "out"
    with pytest.raises(KeyboardInterrupt, match=f"^interrupted after [0-9]+ frames; the map so far is in {out}$"):
        session.run_scene(load_scene(scene))
    assert set(os.listdir(out)) == SAVED
    assert len(read_splats(out / "splats.ply")["position"]) > 20


def full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def elsewhere(_: object) -> None:
    """The disk of the output folder is full."""


def nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    make = results.tempfile.mkdtemp
    monkeypatch.setattr(
        results.tempfile,
        "mkdtemp",
        lambda *at, **how: full() if how.get("prefix") == "modp-ti-map-" else make(*at, **how),
    )


@pytest.mark.parametrize("room_left", [elsewhere, nowhere])
def test_a_live_map_that_does_not_fit_on_the_disk_is_saved_elsewhere(
    room_left: Callable[[pytest.MonkeyPatch], None], scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    monkeypatch.setattr(results.tempfile, "tempdir", None)
    (tmp_path / "tmp").mkdir()
    config = load_scene(scene, ["source.stop=12", "refine.seconds=null", "refine.steps=2"])
    write_map = results.write_map
    monkeypatch.setattr(
        results,
        "write_map",
        lambda folder, *rest: full() if config.output in folder.parents else write_map(folder, *rest),
    )
    room_left(monkeypatch)
    with pytest.raises(InputError) as error:
        session.run_scene(config)
    said, out = str(error.value), scene.parent / "out"
    assert said.startswith(f"{out}: cannot be written: No space left on device; ")
    assert not out.exists()
    if room_left is elsewhere:
        (kept,) = (tmp_path / "tmp").iterdir()
        assert said.endswith(f"; the map is in {kept}")
        assert set(os.listdir(kept)) == SAVED - {".modp-ti"} and len(read_splats(kept / "splats.ply")["position"]) > 20
    else:
        assert said.endswith(f"; nor can {tmp_path / 'tmp'}: No space left on device, and the map is lost")


class Watcher(Observer):
    """Notes what the output folder holds when the evaluation begins."""

    def __init__(self, output: Path) -> None:
        self.output, self.held = output, set[str]()

    def on_stage(self, stage: str) -> None:
        if stage == "evaluating the saved map":
            self.held = set(os.listdir(self.output))


def test_the_finished_map_is_there_before_its_scores_and_stays_without_room_for_them(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = scene.parent / "out"
    with appearing(out) as earlier:
        (earlier / "metrics.json").write_text("{}")
        (earlier / "renders").mkdir()
        (earlier / "renders" / "000000.png").touch()
    watcher = Watcher(out)
    monkeypatch.setattr(stages, "open_observer", lambda *_: watcher)
    monkeypatch.setattr(results, "write_scores", full)
    with pytest.raises(InputError) as error:
        session.run_scene(load_scene(scene, ["source.stop=12", "refine.seconds=null", "refine.steps=2"]))
    assert str(error.value) == (
        f"{out}: cannot be written: No space left on device; the finished map is in {out}, without its scores"
    )
    assert watcher.held == SAVED == set(os.listdir(out))
    assert len(read_splats(out / "splats.ply")["position"]) > 20


@pytest.fixture
def recorded(tmp_path: Path, room: Room) -> Path:
    """A short recording with poses, as it can be resumed."""
    RoomRecording(room, pinhole(64, 48), walk(8)).write(tmp_path)
    file = tmp_path / "scene.yaml"
    file.write_text("""
source:  {path: images, holdout: 4, fps: 10}
tracker: {kind: colmap, path: sparse/0}
output:  out
device:  cpu
mapping: {optimise: {steps: 2}}
refine:  {steps: 3}
export:  {report: false}
""")
    return file


@pytest.mark.parametrize(
    ("stage", "in_its_place"),
    [("mapping", "nothing"), ("refining", "a file"), ("evaluating the saved map", "a folder of someone")],
)
def test_a_map_whose_folder_is_gone_is_saved_where_the_error_says(
    stage: str, in_its_place: str, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, temporary = tmp_path / "out", tmp_path / "tmp"
    temporary.mkdir()
    monkeypatch.setattr(results.tempfile, "tempdir", str(temporary))

    def sabotage() -> None:
        shutil.rmtree(out)
        if in_its_place == "a file":
            out.touch()
        elif in_its_place != "nothing":
            out.mkdir()
            (out / "splats.ply").write_text("mine")

    monkeypatch.setattr(stages, "open_observer", lambda *_: Stopper(stage, 2 if stage == "mapping" else 1, sabotage))
    said = ""
    try:
        session.run_scene(load_scene(recorded))
    except InputError as error:
        said = str(error)
    if in_its_place == "a folder of someone":
        assert (out / "splats.ply").read_text() == "mine" and os.listdir(out) == ["splats.ply"]
    maps = [place for place in (out, *temporary.glob("modp-ti-map-*")) if len(files_in(place)) > 1]
    assert len(maps) == 1 and (maps == [out] if not said else str(maps[0]) in said)
    assert len(read_splats(maps[0] / "splats.ply")["position"]) > 20


def files_in(place: Path) -> list[str]:
    return os.listdir(place) if place.is_dir() else []


@pytest.mark.parametrize(("stage", "fault"), [("mapping", ValueError("a fault")), ("refining", OSError(5, "a fault"))])
def test_a_fault_on_the_way_names_the_snapshot(
    fault: Exception, stage: str, recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail() -> None:
        raise fault

    monkeypatch.setattr(stages, "open_observer", lambda *_: Stopper(stage, 4 if stage == "mapping" else 2, fail))
    with pytest.raises(type(fault)) as raised:
        session.run_scene(load_scene(recorded, ["snapshot_every=2"]))
    out = recorded.parent / "out"
    assert f"--resume {out}" in repr(raised.value) and load_resumed(out, None, [])[1] is not None
