"""The command line: one job, two names, quick help; bad input gets one line, exit code 2 and no files."""

from __future__ import annotations

import subprocess
import sys
import types
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from modp_ti import cli
from modp_ti import run as run_module

PROJECT = Path(__file__).resolve().parents[2]


@pytest.fixture
def session(monkeypatch):
    """Stands in for the mapping session: opens the tracker and keeps its configurations."""
    configs = []

    def run_scene(config, console):
        from modp_ti.trackers import open_tracker

        configs.append(config)
        list(open_tracker(config))
        config.output.mkdir(parents=True)
        return config.output

    module = types.ModuleType("modp_ti.session")
    module.run_scene = run_scene
    monkeypatch.setitem(sys.modules, "modp_ti.session", module)
    return configs


def job() -> typer.Typer:
    app = typer.Typer()
    app.command()(run_module.run)
    return app


def invoke(*arguments: str | Path):
    """The result of `modp-ti run`, checked to be that of `python -m modp_ti.run`."""
    first = CliRunner().invoke(cli.app, ["run", *map(str, arguments)])
    if first.exit_code:
        second = CliRunner().invoke(job(), [*map(str, arguments)])
        assert (second.exit_code, second.stderr) == (first.exit_code, first.stderr)
    return first


@pytest.fixture
def scene(plane_scene):
    import numpy as np

    plane_scene.write_colmap(np.random.default_rng(0).uniform(-1, 1, (30, 3)) * [1.8, 1.8, 0])
    file = plane_scene.folder.parent / "scene.yaml"
    file.write_text("source: {path: images}\ntracker: {kind: colmap}\noutput: out\n")
    return file


def failure(scene: Path, *arguments: str) -> str:
    result = invoke(scene, *arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert not (scene.parent / "out").exists(), "nothing half-written"
    return result.stderr


def test_run_maps_the_scene_and_says_where_the_result_lies(scene, session):
    result = invoke(scene)
    assert result.exit_code == 0, result.output
    assert result.stdout == f"written to {(scene.parent / 'out').resolve()}\n"
    assert session[0].source.path == (scene.parent / "images").resolve()


def test_overrides_may_follow_each_other_or_repeat_the_option(scene, session):
    invoke(scene, "--set", "seed=4", "source.scale=0.5", "--set", "threads=1")
    assert (session[0].seed, session[0].source.scale, session[0].threads) == (4, 0.5, 1)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--set", "source.scal=1"], "unknown key `source.scal`; did you mean `source.scale`?"),
        (["--set", "source.scale=7"], "source.scale: must be less than or equal to 1, not 7"),
        (["--set", "source.path=gone"], "gone: no such folder of images"),
        (["--set", "tracker.path=gone"], "gone: no such folder (tracker.path)"),
        (["--set", "output=scene.yaml"], "output must be a folder, this is a file"),
    ],
)
def test_bad_input_gets_one_line_and_exit_code_two(scene, session, arguments, part):
    assert part in failure(scene, *arguments)


def test_faulty_data_set_or_video_gets_one_line(scene, session):
    folder = scene.parent
    (folder / "fr1").mkdir()
    (folder / "fr1" / "rgb.txt").write_text("# time file\n1.0 rgb/1.png\n0.5 rgb/2.png\n")
    said = failure(scene, "--set", "source.path=fr1")
    assert "rgb.txt:3: time stamp 0.5 is not later than the one before; sort the listing" in said
    (folder / "walk.mp4").write_bytes(b"\0\0\0\x10ftypisom\0\0\0\0\0\1\0\0mdat")
    said = failure(scene, "--set", "source.path=walk.mp4")
    assert "walk.mp4: the video is cut off, 65528 bytes are missing: copy it again" in said


def test_missing_scene_file_gets_one_line(tmp_path, session):
    assert "gone.yaml: no such scene file" in failure(tmp_path / "gone.yaml")


def test_damaged_image_gets_one_line(scene, session):
    file = scene.parent / "images" / "view12.png"
    file.write_bytes(file.read_bytes()[:1000])
    assert "view12.png: unreadable image: the file is cut off" in failure(scene)


def test_message_of_several_lines_is_put_on_one(scene, monkeypatch):
    from modp_ti.errors import InputError

    module = types.ModuleType("modp_ti.session")

    def run_scene(config, console):
        raise InputError("first\n  second")

    module.run_scene = run_scene
    monkeypatch.setitem(sys.modules, "modp_ti.session", module)
    assert failure(scene) == "error: first second\n"


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=PROJECT, capture_output=True, text=True, check=True)


HEAVY = "('taichi', 'torch', 'open3d', 'cv2', 'pycolmap')"


def test_help_imports_nothing_heavy():
    code = f"import sys, modp_ti.cli; print([name for name in {HEAVY} if name in sys.modules])"
    assert python(code).stdout.strip() == "[]"
    result = subprocess.run(
        [sys.executable, "-m", "modp_ti.cli", "--help"],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "run" in result.stdout


def test_readers_need_no_compiler_and_no_torch(scene):
    code = (
        "import sys; from modp_ti.config import load_scene; from modp_ti.trackers import open_tracker; "
        f"print(len(list(open_tracker(load_scene({str(scene)!r}))))); "
        "import modp_ti.trackers.transforms, modp_ti.exports.trajectory; "
        "print([name for name in ('taichi', 'torch', 'open3d') if name in sys.modules])"
    )
    assert python(code).stdout.split("\n")[:2] == ["7", "[]"]
