"""The command line: one job, two names, quick help and completion; what is printed where, and the exit codes."""

from __future__ import annotations

import itertools
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import types
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

import modp_ti
from fields.runtime.engine import engine
from modp_ti.commands import app as cli
from modp_ti.commands import run as run_module
from modp_ti.commands import shared as command_line
from modp_ti.config.presets import PRESETS
from tests.patience import PATIENCE

PROJECT = Path(__file__).resolve().parents[3]


@pytest.fixture
def session(monkeypatch):
    """Stands in for the mapping session: opens the tracker and keeps its configurations."""
    configs = []

    def run_scene(config, console, resumed=None):
        from modp_ti.inputs.trackers import open_tracker

        configs.append(config)
        list(open_tracker(config))
        console.print("3 of 7 mapped")
        print("printed by a library")
        config.output.mkdir(parents=True)
        (config.output / "metrics.json").write_text('{"frames": 7}')
        return config.output

    module = types.ModuleType("modp_ti.engine.session")
    module.run_scene = run_scene
    monkeypatch.setitem(sys.modules, "modp_ti.engine.session", module)
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
def scene(plane_scene, monkeypatch):
    import numpy as np

    plane_scene.write_colmap(np.random.default_rng(0).uniform(-1, 1, (30, 3)) * [1.8, 1.8, 0])
    file = plane_scene.folder.parent / "scene.yaml"
    monkeypatch.chdir(file.parent)
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
    assert result.stdout == f"printed by a library\nwritten to {(scene.parent / 'out').resolve()}\n"
    assert session[0].source.path == (scene.parent / "images").resolve()


def test_overrides_may_follow_each_other_or_repeat_the_option(scene, session):
    invoke(scene, "--set", "seed=4", "source.scale=0.5", "--set", "threads=1")
    assert (session[0].seed, session[0].source.scale, session[0].threads) == (4, 0.5, 1)


def test_a_map_to_go_on_with_is_relative_to_the_working_folder(scene, session, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = invoke(scene, "--onto", "first: a/map")
    assert result.exit_code == 0, result.output
    assert session[0].onto == (tmp_path / "first: a" / "map").resolve()
    for option, more in itertools.product(("--resume", "--replay"), (("--onto", "first"), ("--parts", "2"))):
        refused = invoke(option, "out", *more)
        assert refused.exit_code == 2 and refused.stderr.startswith(f"error: {more[0]} is for a scene")


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_set_what_is_not_given(scene, session, preset):
    invoke(scene, f"--{preset}", "--set", "refine.steps=9")
    assert session[0].refine.steps == 9
    assert session[0].mapping.optimise.steps == PRESETS[preset].settings["mapping.optimise.steps"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["scene.yaml", "--fast", "--best"], "--fast and --best are two presets: give one of them"),
        (["--resume", "out", "--fast"], "--fast is for a scene file: a run that goes on has its settings already"),
    ],
)
def test_presets_that_do_not_apply_are_refused(session, arguments, said):
    result = invoke(*arguments)
    assert (result.exit_code, result.stderr, session) == (2, f"error: {said}\n", [])


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--set", "source.scal=1"], "unknown key `source.scal`; did you mean `source.scale`?"),
        (["--set", "source.scale=7"], "source.scale: must be less than or equal to 1, not 7"),
        (["--set", "source.path=gone"], "gone: no such folder of images"),
        (["--set", "tracker.path=gone"], "gone: no such folder (tracker.path)"),
        (["--set", "output=scene.yaml"], "output must be a folder, this is a file"),
        (["--engine", "local"], "--engine and --address are for --parts, whose tasks they carry out"),
    ],
)
def test_bad_input_gets_one_line_and_exit_code_two(scene, session, arguments, part):
    assert part in failure(scene, *arguments)


def test_faulty_data_set_or_video_gets_one_line(scene, session):
    (folder := scene.parent / "fr1").mkdir()
    (folder / "rgb.txt").write_text("# time file\n1.0 rgb/1.png\n0.5 rgb/2.png\n")
    said = failure(scene, "--set", "source.path=fr1")
    assert "rgb.txt:3: time stamp 0.5 is not later than the one before; sort the listing" in said
    (scene.parent / "walk.mp4").write_bytes(b"\0\0\0\x10ftypisom\0\0\0\0\0\1\0\0mdat")
    said = failure(scene, "--set", "source.path=walk.mp4")
    assert "walk.mp4: the video is cut off, 65528 bytes are missing: copy it again" in said


def test_missing_scene_file_gets_one_line(tmp_path, session):
    assert "gone.yaml: no such scene file" in failure(tmp_path / "gone.yaml")


def test_damaged_image_gets_one_line(scene, session):
    os.truncate(scene.parent / "images" / "view12.png", 1000)
    assert "view12.png: unreadable image: the file is cut off" in failure(scene)


def test_message_of_several_lines_is_put_on_one(scene, monkeypatch):
    from modp_ti.files.errors import InputError

    failing_with(InputError("first\n  second"), monkeypatch)
    assert failure(scene) == "error: first second\n"


def python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=PROJECT, capture_output=True, text=True, check=True)


HEAVY = "('taichi', 'quadrants', 'torch', 'open3d', 'cv2', 'pycolmap')"


def test_help_imports_nothing_heavy():
    code = f"import sys, modp_ti.commands.app; print([name for name in {HEAVY} if name in sys.modules])"
    assert python(code).stdout.strip() == "[]"
    result = subprocess.run(
        [sys.executable, "-m", "modp_ti.commands.app", "--help"],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "run" in result.stdout


def test_readers_need_no_compiler_and_no_torch(scene):
    code = (
        "import sys; from modp_ti.config.scene_file import load_scene; "
        "from modp_ti.inputs.trackers import open_tracker; "
        f"print(len(list(open_tracker(load_scene({str(scene)!r}))))); "
        "import modp_ti.inputs.trackers.transforms, modp_ti.outputs.formats.trajectory; "
        "print([name for name in ('taichi', 'quadrants', 'torch', 'open3d') if name in sys.modules])"
    )
    assert python(code).stdout.split("\n")[:2] == ["7", "[]"]


def test_a_run_says_progress_on_one_channel_and_its_result_on_the_other(scene, session):
    shown = invoke(scene)
    assert "3 of 7 mapped" in shown.stderr and "3 of 7 mapped" not in shown.stdout
    shutil.rmtree(scene.parent / "out")
    quiet = invoke(scene, "--quiet")
    assert (quiet.stdout, quiet.stderr) == (shown.stdout, "")


def test_json_is_one_object_with_what_a_run_has_measured(scene, session):
    result = invoke(scene, "--json")
    assert json.loads(result.stdout) == {
        "exit_code": 0,
        "output": str((scene.parent / "out").resolve()),
        "metrics": {"frames": 7},
    }
    assert "printed by a library" in result.stderr


@pytest.mark.parametrize("quiet", [[], ["--quiet"]])
def test_errors_are_said_to_people_and_to_programs_whatever_else_is_not(tmp_path, quiet):
    for command in (["run", "gone.yaml"], ["warmup", "gone.yaml"], ["render", "gone"], ["export", "gone", "-f", "spz"]):
        result = CliRunner().invoke(cli.app, [*command, "--json", *quiet])
        data = json.loads(result.stdout)
        assert (result.exit_code, data["exit_code"]) == (2, 2)
        assert list(data) == ["exit_code", "error"] and "gone" in data["error"]
        assert result.stderr == f"error: {data['error']}\n"
    result = CliRunner().invoke(cli.app, ["check", "gone.yaml", "--json", *quiet])
    data = json.loads(result.stdout)
    assert (result.exit_code, data["exit_code"], data["verdict"]) == (2, 2, "unusable")


def failing_with(error: BaseException, monkeypatch) -> None:
    module = types.ModuleType("modp_ti.engine.session")

    def run_scene(config, console, resumed=None):
        raise error

    module.run_scene = run_scene
    monkeypatch.setitem(sys.modules, "modp_ti.engine.session", module)


def test_a_fault_of_the_program_has_a_traceback_and_a_code_of_its_own(scene, monkeypatch):
    failing_with(ZeroDivisionError("of all things"), monkeypatch)
    result = CliRunner().invoke(cli.app, ["run", str(scene), "--json"])
    assert (result.exit_code, json.loads(result.stdout)["exit_code"]) == (3, 3)
    assert "Traceback" in result.stderr and "in run_scene" in result.stderr
    assert "a fault of the program" in result.stderr.splitlines()[-1]


def test_an_interrupted_command_says_so_and_ends_with_130(scene, monkeypatch):
    failing_with(KeyboardInterrupt(), monkeypatch)
    result = CliRunner().invoke(cli.app, ["run", str(scene)])
    assert (result.exit_code, result.stdout, result.stderr) == (130, "", "error: interrupted\n")


def test_ctrl_c_ends_a_real_process_with_130_and_leaves_nothing(scene):
    code = (
        "import os, sys, types, time; sys.argv[0] = 'modp-ti'; module = types.ModuleType('modp_ti.engine.session')\n"
        "def run_scene(config, console, resumed=None):\n"
        "    config.output.with_name('out.partial').mkdir()\n"
        "    try: os.write(1, b'begun\\n'); time.sleep(60)\n"
        "    finally: config.output.with_name('out.partial').rmdir()\n"
        "module.run_scene = run_scene; sys.modules['modp_ti.engine.session'] = module\n"
        "from modp_ti.commands.app import app; app()"
    )
    command = [sys.executable, "-c", code, "run", str(scene), "--json"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    # Where the tests run in a shell's background, children inherit that Ctrl-C is ignored.
    process = subprocess.Popen(
        command, cwd=PROJECT, **pipes, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    )
    assert process.stderr.readline() == "begun\n"  # what a library writes past Python goes there as well
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert json.loads(out) == {"exit_code": 130, "error": "interrupted"}
    assert err == "error: interrupted\n"
    assert sorted(p.name for p in scene.parent.iterdir()) == ["images", "scene.yaml", "sparse"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["run"],
        ["run", "a.yaml", "--nonsense"],
        ["run", "a.yaml", "--parts", "1"],
        ["run", "a.yaml", "--set"],
        ["export", "out"],
        ["export", "out", "--format", "nonsense"],
        ["check"],
        ["locate", "out"],
        ["nonsense"],
        ["--nonsense"],
    ],
)
def test_wrong_options_end_with_two_in_one_line_and_in_json(arguments):
    result = CliRunner().invoke(cli.app, arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    error = result.stderr.removeprefix("error: ").rstrip("\n")
    result = CliRunner().invoke(cli.app, [arguments[0], "--json", *arguments[1:]])
    assert result.exit_code == 2
    told = json.loads(result.stdout)
    assert told["exit_code"] == 2 and told["error"]
    if arguments[0].isalpha() and arguments != ["nonsense"]:  # a group has no --json, which is the first mistake then
        assert told["error"] == error


def test_without_a_word_the_program_prints_its_help():
    result = CliRunner().invoke(cli.app, [])
    assert "Usage:" in result.output and "Examples:" in result.output


def test_help_on_a_narrow_terminal_names_whole_options():
    command = [sys.executable, "-m", "modp_ti.commands.app", "export", "--help"]
    narrow = {**os.environ, "COLUMNS": "40"}
    text = subprocess.run(command, env=narrow, cwd=PROJECT, capture_output=True, text=True, check=True).stdout
    for option in ("--format", "--output", "--texture", "--spz-version", "--device"):
        assert f"{option} " in text.replace("\n", " ")
    assert "\u2026" not in text


COMMANDS = ["run", "batch", "refine", "cameras", "check", "render", "export", "locate", "view", "warmup"]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches_by_examples_and_commands_can_be_quiet_and_speak_json(command):
    text = CliRunner().invoke(cli.app, [command, "--help"], terminal_width=200).stdout
    assert "--quiet" in text
    assert ("--json" in text) == (command != "view")  # which has no end to report
    lines = [line.strip() for line in text.partition("Examples:")[2].splitlines() if line.strip()]
    assert len(lines) > 1 and all(f"{line} ".startswith(f"modp-ti {command} ") for line in lines)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_examples_are_calls_that_the_command_takes(command):
    epilog = next(info.epilog for info in cli.app.registered_commands if info.name == command)
    click_app = typer.main.get_command(cli.app)
    calls = [line.split("   (")[0].split(" > ")[0] for line in epilog.splitlines()[1:]]
    for call in (part for line in calls for part in line.split("&&")):
        words = shlex.split(call)
        assert words[0] == "modp-ti"
        sub = click_app.commands[words[1]]
        sub.make_context(words[1], words[2:])  # raises for options that it does not have


def test_the_page_of_commands_names_every_command_option_and_exit_code():
    page = (PROJECT / "docs" / "commands.md").read_text()
    click_app = typer.main.get_command(cli.app)
    for name, sub in click_app.commands.items():
        assert f"modp-ti {name} " in page
        for option in (word for parameter in sub.params for word in parameter.opts if word.startswith("-")):
            assert f"`{option}" in page or option == "--help", f"{name} {option}"
    for code in (0, 1, command_line.BAD_INPUT, command_line.FAULT, 129, 130, 143):
        assert f"| {code} | " in page


def test_version():
    result = CliRunner().invoke(cli.app, ["--version"])
    assert (result.exit_code, result.stdout) == (
        0,
        f"modp-ti {modp_ti.__version__} ({engine()})\n",
    )


def completed(line: str) -> tuple[list[str], str]:
    """What bash is offered at the end of a line, and the heavy libraries that were loaded for it."""
    code = (
        "import sys; sys.argv[0] = 'modp-ti'\n"
        "from modp_ti.commands.app import app\n"
        "try: app()\n"
        f"finally: print([name for name in {HEAVY_TO_COMPLETE} if name in sys.modules], file=sys.stderr)"
    )
    words = line.split(" ")
    environment = os.environ | {
        "_MODP_TI_COMPLETE": "complete_bash",
        "COMP_WORDS": "\n".join(words),
        "COMP_CWORD": str(len(words) - 1),
    }
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=PROJECT, env=environment, capture_output=True, text=True, check=False
    )
    return done.stdout.split(), done.stderr.strip()


HEAVY_TO_COMPLETE = "('taichi', 'quadrants', 'torch', 'open3d', 'pycolmap', 'matplotlib')"


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("modp-ti ", COMMANDS),
        ("modp-ti run scene.yaml --q", ["--quiet"]),
        ("modp-ti export out --format sp", ["splat", "spz", "splat-glb"]),
        ("modp-ti render out --path ", ["recorded", "smoothed", "orbit"]),
        ("modp-ti run scene.yaml --set source.sc", ["source.scale=auto"]),
        ("modp-ti run scene.yaml --set tracker.kind=tu", ["tracker.kind=tum"]),
    ],
)
def test_the_shell_is_offered_commands_options_and_values_without_waiting(line, offered):
    assert completed(line) == (offered, "[]")


def test_every_setting_that_is_offered_is_one_that_the_scene_takes(scene):
    from modp_ti.commands.shared import matching_settings
    from modp_ti.config.keys import documented_keys
    from modp_ti.config.scene_file import load_scene
    from modp_ti.config.settings import SceneConfig

    offered = [value for value, _ in matching_settings("")]
    keys = [value.partition("=")[0] for value in offered]
    assert list(dict.fromkeys(keys)) == list(dict.fromkeys(entry.key for entry in documented_keys(SceneConfig)))
    assert len(set(offered)) == len(offered) and "tracker.kind=colmap" in offered
    defaults = [value for value in offered if not value.endswith("=")]
    assert len(defaults) > 100
    of_klt = ("tracker.loops", "tracker.maps")
    of_sfm = [f"tracker.{name}" for name in ("order", "mapper", "overlap", "features")]
    of_captures = ("tracker.adjust", "tracker.max_points", "tracker.max_depth", "tracker.depth")
    of_others = (*of_klt, *of_sfm, *of_captures, "tracker.max_gap")
    others = ("source.vrs", "tracker.kind", *of_others)  # for other kinds than the scene's
    loaded = load_scene(scene, [value for value in defaults if not value.startswith(others)])
    assert loaded == load_scene(scene, [])
    klt = load_scene(scene, ["tracker={kind: klt}"])
    assert load_scene(scene, ["tracker={kind: klt}", *(v for v in defaults if v.startswith(of_klt))]) == klt


def test_the_completion_of_bash_can_be_had():
    code = "import sys; sys.argv[0] = 'modp-ti'; from modp_ti.commands.app import app; app()"
    environment = os.environ | {"_MODP_TI_COMPLETE": "source_bash"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=PROJECT, env=environment, capture_output=True, text=True, check=True
    )
    assert "complete -o default -F _modp_ti_completion modp-ti" in done.stdout
