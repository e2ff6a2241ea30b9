"""`modp-ti run` without a scene file: what is mapped, where the map goes, and what is refused."""

from __future__ import annotations

import sys
import types

import pytest
from PIL import Image
from typer.testing import CliRunner

from modp_ti.commands import app as cli
from modp_ti.config.bare_recording import recorded_scene
from modp_ti.config.presets import PRESETS
from modp_ti.config.scene_file import dump_scene, load_scene
from modp_ti.files.errors import InputError


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The working directory, with a folder of images and two videos whose content nobody looks at."""
    monkeypatch.chdir(tmp_path)
    for file in ("hall/a.png", "room.mp4", "other/room.mp4"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    return tmp_path


@pytest.fixture
def session(monkeypatch):
    """Stands in for the mapping session: keeps its configurations, and writes what tells a run's recording."""
    configs = []

    def run_scene(config, console, resumed=None, began=None):
        configs.append(config)
        config.output.mkdir(parents=True, exist_ok=True)
        dump_scene(config, config.output / "config.yaml")
        return config.output

    module = types.ModuleType("modp_ti.engine.session")
    module.__dict__["run_scene"] = run_scene
    monkeypatch.setitem(sys.modules, "modp_ti.engine.session", module)
    return configs


def invoke(*arguments: str):
    return CliRunner().invoke(cli.app, ["run", *arguments])


def mapped(session: list, *arguments: str):
    """The settings of a run that succeeds."""
    result = invoke(*arguments)
    assert result.exit_code == 0, result.output
    assert result.stdout == f"written to {session[-1].output}\n"
    return session[-1]


def refusal(*arguments: str) -> str:
    result = invoke(*arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    return result.stderr


@pytest.mark.parametrize(("recording", "name"), [("room.mp4", "room"), ("hall", "hall"), ("hall/", "hall")])
def test_a_recording_is_mapped_with_defaults_to_a_folder_of_its_name(folder, session, recording, name):
    tracker = "{kind: klt, fallback: sfm}"
    (folder / "scene.yaml").write_text(f"source: {{path: {recording}}}\ntracker: {tracker}\noutput: out/{name}\n")
    assert mapped(session, recording) == load_scene(folder / "scene.yaml")


def test_the_folder_one_is_in_has_its_own_name(folder, session, monkeypatch):
    monkeypatch.chdir(folder / "hall")
    assert mapped(session, ".").output == folder / "hall/out/hall"


@pytest.mark.parametrize(
    ("stream", "meant", "name"),
    [
        ("0", 0, "camera-0"),
        ("/dev/video2", "/dev/video2", "video2"),
        ("rtsp://user:secret@192.168.0.20:554/live/1?key=secret", None, "192.168.0.20-live-1"),
        ("http://[", None, "stream"),
    ],
)
def test_a_stream_is_mapped_to_a_folder_named_without_its_secrets(folder, session, stream, meant, name):
    config = mapped(session, "--stream", stream)
    assert (config.source.stream, config.source.path) == (stream if meant is None else meant, None)
    assert config.tracker.kind == "klt"
    assert config.output == folder / "out" / name


@pytest.mark.parametrize("recording", [["room.mp4"], ["--stream", "0"]])
def test_presets_and_settings_combine(folder, session, recording):
    settings = ["--set", "refine.steps=9", "--set", "output=there", "source.stop=5"]
    config = mapped(session, *recording, "--fast", *settings)
    assert config.mapping.optimise.steps == PRESETS["fast"].settings["mapping.optimise.steps"]
    assert (config.refine.steps, config.source.stop, config.output) == (9, 5, folder / "there")


def test_another_tracker_may_be_set(session):
    assert (
        mapped(session, "hall", "--set", "tracker.kind=colmap", "--set", "tracker.path=sparse").tracker.kind == "colmap"
    )


def test_a_second_run_replaces_the_map_of_the_same_recording_only(folder, session):
    first = mapped(session, "room.mp4").output
    assert mapped(session, "room.mp4").output == first
    assert mapped(session, "other/room.mp4").output == folder / "out/room-2"
    assert mapped(session, "other/room.mp4").output == folder / "out/room-2"
    (first / "config.yaml").write_text("nothing: of this version\n")
    assert mapped(session, "room.mp4").output == folder / "out/room-3"


def test_every_recording_of_a_camera_gets_a_folder_of_its_own(folder, session):
    names = [mapped(session, "--stream", "0").output.name for _ in range(3)]
    assert names == ["camera-0", "camera-0-2", "camera-0-3"]


def test_a_name_that_no_folder_can_have_is_shortened(folder):
    (folder / f"{'ü' * 120}.mp4").touch()
    output = recorded_scene(folder / f"{'ü' * 120}.mp4").output
    assert output.name == "ü" * 60


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["gone.yaml"], "gone.yaml: no such file"),
        (["gone"], "gone: no such file"),
        (["room.mp4", "--stream", "0"], "--stream and --replay need no scene file and no --resume: give one of them"),
        (["room.mp4", "--replay", "out"], "--stream and --replay need no scene file and no --resume: give one of them"),
        (
            ["--resume", "out", "--stream", "0"],
            "--stream and --replay need no scene file and no --resume: give one of them",
        ),
        (["room.mp4", "--resume", "out"], "room.mp4: --resume has the recording already; leave it out"),
        (["--stream", "0", "--set", "tracker.kind=colmap"], "source.stream cannot be combined with"),
        (["room.mp4", "--set", "source.scal=1"], "unknown key `source.scal`; did you mean `source.scale`?"),
        (["room.mp4", "--set", "output=room.mp4"], "(output)"),
        (["room.mp4", "--fast", "--best"], "--fast and --best are two presets: give one of them"),
    ],
)
def test_what_cannot_be_meant_is_refused_in_one_line(session, arguments, said):
    assert said in refusal(*arguments)
    assert session == []


POSED = {
    "transforms.json": ("transforms", "room"),
    "sparse/0/images.bin": ("colmap", "room"),
    "colmap/sparse/0/images.txt": ("colmap", "room"),
    "images/transforms.json": ("klt", "room"),
}


@pytest.mark.parametrize("file", POSED)
def test_poses_that_lie_in_the_folder_are_used_and_named(folder, file):
    """Those of reduced copies of the images do not count."""
    for name in ("images/a.png", "images_2/a.png", file):
        (folder / "room" / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / "room" / name).touch()
    said: list[str] = []
    config = recorded_scene(folder / "room", say=said.append)
    assert (config.tracker.kind, config.output.name) == POSED[file]
    assert config.source.path == folder / "room/images"
    assert len(said) == (config.tracker.kind != "klt")
    assert recorded_scene(folder / "room", ["tracker.kind=klt"]).tracker.kind == "klt"
    assert recorded_scene(folder / "room", ["tracker.maps=all"]).tracker.kind == "klt"


def test_photographs_are_for_sfm_unless_a_tracker_is_named(folder):
    (folder / "photos").mkdir()
    Image.new("RGB", (64, 48)).save(folder / "photos/1.png")
    Image.new("RGB", (48, 64)).save(folder / "photos/2.png")
    said: list[str] = []
    assert recorded_scene(folder / "photos", say=said.append).tracker.kind == "sfm"
    assert len(said) == 1 and "tracker.kind=sfm" in said[0] and "tracker.kind=klt" in said[0]
    for setting in ("tracker.kind=klt", "tracker.maps=all", "source.realtime=true", "source.stop=1"):
        assert recorded_scene(folder / "photos", [setting]).tracker.kind == "klt"
    assert recorded_scene(folder / "photos", ["tracker.kind=klt"]) == recorded_scene(
        folder / "photos", ["tracker.kind=klt", "tracker.fallback=null"]
    )


@pytest.mark.parametrize(("name", "kind"), [("rgbd_dataset_freiburg1_xyz", "tum"), ("mine", "klt")])
def test_a_trajectory_is_used_where_the_camera_is_known(folder, name, kind):
    (folder / name / "rgb").mkdir(parents=True)
    Image.new("RGB", (640, 480)).save(folder / name / "rgb/1.0.png")
    (folder / name / "rgb.txt").write_text("1.0 rgb/1.0.png\n")
    (folder / name / "groundtruth.txt").touch()
    said: list[str] = []
    assert recorded_scene(folder / name, say=said.append).tracker.kind == kind
    assert len(said) == 1 and "groundtruth.txt" in said[0]
    assert recorded_scene(folder / name, ["source.intrinsics.fx=500"]).tracker.kind == "tum"


def test_a_folder_that_holds_one_video_maps_it(folder):
    assert recorded_scene(folder / "other").source.path == folder / "other/room.mp4"
    (folder / "other/b.MOV").touch()
    with pytest.raises(InputError, match=r"b\.MOV, room\.mp4"):
        recorded_scene(folder / "other")


def test_a_folder_of_recordings_names_them(folder):
    for name in ("one", "two"):
        (folder / "all" / name / "rgb").mkdir(parents=True)
        (folder / "all" / name / "rgb.txt").touch()
        (folder / "all" / name / "rgb/1.png").touch()
    with pytest.raises(InputError, match="one, two"):
        recorded_scene(folder / "all")


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("https://user:secret@host/room.mp4", "--stream"),
        ("hall/a.png", "folder"),
        ("room.tar.gz", "unpack"),
    ],
)
@pytest.mark.parametrize("command", ["run", "check"])
def test_what_is_no_recording_is_refused_with_the_right_command(folder, command, argument, said):
    (folder / "room.tar.gz").touch()
    result = CliRunner().invoke(cli.app, [command, argument])
    assert result.exit_code == 2
    shown = " ".join((result.stdout + result.stderr).split())
    assert said in shown and "secret" not in shown and "Traceback" not in shown


def test_several_recordings_are_a_batch():
    assert "modp-ti batch" in refusal("hall/a.png", "hall/b.png")


def test_a_folder_with_a_scene_file_is_not_taken_for_its_images(folder, session):
    (folder / "hall" / "scene.yaml").touch()
    assert "hall has a scene.yaml: name that file, or the folder of the images" in refusal("hall")


def test_an_empty_command_line_says_what_can_be_named():
    result = invoke()
    assert result.exit_code == 2
    assert "--stream" in result.stderr and "--resume" in result.stderr


def test_a_missing_video_is_named_by_the_real_session():
    assert "gone.mp4: no such video file (source.path)" in refusal("gone.mp4", "--quiet")


def test_a_missing_camera_is_named_by_the_real_session():
    assert "camera 99: no such camera, or it is in use (source.stream)" in refusal("--stream", "99", "--quiet")
