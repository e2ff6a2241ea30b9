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

import numpy as np
import pytest
import typer
from typer.testing import CliRunner, Result

import modp_ti
from fields.runtime.engine import engine
from modp_ti.commands import app as cli
from modp_ti.commands import shared
from modp_ti.commands.shared import matching_settings
from modp_ti.config.keys import documented_keys
from modp_ti.config.presets import PRESETS
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.files.errors import InputError
from tests.patience import PATIENCE

PROJECT = Path(__file__).resolve().parents[3]
COMMANDS = ["run", "batch", "refine", "clean", "crop", "scale", "cameras", "check"]
COMMANDS += ["render", "export", "measure", "locate", "view", "warmup"]
HEAVY = "('taichi', 'quadrants', 'torch', 'open3d', 'cv2', 'pycolmap')"


@pytest.fixture
def session(monkeypatch):
    """Stands in for the mapping session: opens the tracker and keeps its configurations, or raises `failing`."""
    configs = []

    def run_scene(config, console, resumed=None, began=None):
        if module.failing is not None:
            raise module.failing
        configs.append(config)
        list(modp_ti.open_tracker(config))
        console.print("3 of 7 mapped")
        print("printed by a library")
        config.output.mkdir(parents=True)
        (config.output / "metrics.json").write_text('{"frames": 7}')
        return config.output

    module = types.SimpleNamespace(run_scene=run_scene, failing=None, configs=configs)
    monkeypatch.setitem(sys.modules, "modp_ti.engine.session", module)
    return module


def invoke(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli.app, [*map(str, arguments)])


@pytest.fixture
def scene(plane_scene, monkeypatch):
    plane_scene.write_colmap(np.random.default_rng(0).uniform(-1, 1, (30, 3)) * [1.8, 1.8, 0])
    file = plane_scene.folder.parent / "scene.yaml"
    monkeypatch.chdir(file.parent)
    file.write_text("source: {path: images}\ntracker: {kind: colmap}\noutput: out\n")
    return file


def refused(*arguments: str | Path, names: str) -> None:
    """A call that ends in one line with what it names, and leaves nothing."""
    result = invoke(*arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    assert names in result.stderr and not Path("out").exists()


def test_a_run_says_progress_on_one_channel_and_its_result_on_the_other(scene, session):
    result = invoke("run", scene)
    assert result.exit_code == 0, result.output
    assert result.stdout == f"printed by a library\nwritten to {(scene.parent / 'out').resolve()}\n"
    assert "3 of 7 mapped" in result.stderr and session.configs[0].source.path == (scene.parent / "images").resolve()
    shutil.rmtree("out")
    quiet = invoke("run", scene, "--quiet")
    assert (quiet.stdout, quiet.stderr) == (result.stdout, "")
    shutil.rmtree("out")
    told = invoke("run", scene, "--json")
    output = str((scene.parent / "out").resolve())
    assert json.loads(told.stdout) == {"exit_code": 0, "output": output, "metrics": {"frames": 7}}
    assert "printed by a library" in told.stderr


def test_overrides_may_follow_each_other_or_repeat_the_option_and_win_over_presets(scene, session):
    for preset in PRESETS:
        invoke("run", scene, f"--{preset}", "--set", "seed=4", "source.scale=0.5", "--set", "refine.steps=9")
        config = session.configs.pop()
        assert (config.seed, config.source.scale, config.refine.steps) == (4, 0.5, 9)
        assert config.mapping.optimise.steps == PRESETS[preset].settings["mapping.optimise.steps"]
        shutil.rmtree("out")


def test_a_map_to_continue_is_relative_to_the_working_folder(scene, session, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert invoke("run", scene, "--onto", "first: a/map").exit_code == 0
    assert session.configs[0].onto == (tmp_path / "first: a" / "map").resolve()


def test_a_run_that_is_resumed_or_repeated_has_its_settings_already(scene, session):
    for option, more in itertools.product(("--resume", "--replay"), (("--onto", "a"), ("--parts", "2"), ("--fast",))):
        refused("run", option, "out", *more, names=more[0])


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--set", "source.scal=1"], "source.scal"),
        (["--set", "source.scale=7"], "source.scale"),
        (["--set", "source.path=gone"], "gone"),
        (["--set", "tracker.path=gone"], "gone"),
        (["--set", "output=scene.yaml"], "output"),
        (["--engine", "local"], "--engine"),
        (["--fast", "--best"], "--best"),
        (["--stream", "0"], "--stream"),
    ],
)
def test_bad_input_gets_one_line_and_exit_code_two(scene, session, arguments, named):
    refused("run", scene, *arguments, names=named)


def test_a_faulty_file_of_each_kind_of_source_gets_one_line(scene, session, tmp_path):
    refused("run", tmp_path / "gone.yaml", names="gone.yaml")
    (folder := scene.parent / "fr1").mkdir()
    (folder / "rgb.txt").write_text("# time file\n1.0 rgb/1.png\n0.5 rgb/2.png\n")
    refused("run", scene, "--set", "source.path=fr1", names="rgb.txt:3")
    (scene.parent / "walk.mp4").write_bytes(b"\0\0\0\x10ftypisom\0\0\0\0\0\1\0\0mdat")
    refused("run", scene, "--set", "source.path=walk.mp4", names="walk.mp4")
    os.truncate(scene.parent / "images" / "view12.png", 1000)
    refused("run", scene, names="view12.png")


def python(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    there = os.environ | environment
    return subprocess.run(command, cwd=PROJECT, env=there, capture_output=True, text=True, check=False)


def test_help_imports_nothing_heavy_and_the_main_job_has_a_module():
    code = f"import sys, modp_ti.commands.app; print([name for name in {HEAVY} if name in sys.modules])"
    assert python("-c", code).stdout.strip() == "[]"
    for module in (["modp_ti.commands.app", "run"], ["modp_ti.run"]):
        shown = python("-m", *module, "--help", COLUMNS="200").stdout
        assert "--onto" in shown and "modp-ti run scene.yaml" in shown


def test_readers_need_no_compiler_and_no_torch(scene):
    code = (
        "import sys, modp_ti; "
        f"print(len(list(modp_ti.open_tracker(modp_ti.load_scene({str(scene)!r}))))); "
        "print([name for name in ('taichi', 'quadrants', 'torch', 'open3d') if name in sys.modules])"
    )
    assert python("-c", code).stdout.split("\n")[:2] == ["7", "[]"]


@pytest.mark.parametrize("quiet", [[], ["--quiet"]])
def test_errors_are_said_to_people_and_to_programs_whatever_else_is_not(tmp_path, quiet):
    for command in (["run", "gone.yaml"], ["warmup", "gone.yaml"], ["render", "gone"], ["export", "gone", "-f", "spz"]):
        result = invoke(*command, "--json", *quiet)
        data = json.loads(result.stdout)
        assert (result.exit_code, data["exit_code"]) == (2, 2)
        assert list(data) == ["exit_code", "error"] and "gone" in data["error"]
        assert result.stderr == f"error: {data['error']}\n"
    result = invoke("check", "gone.yaml", "--json", *quiet)
    data = json.loads(result.stdout)
    assert (result.exit_code, data["exit_code"], data["verdict"]) == (2, 2, "unusable")


def test_a_fault_of_the_program_has_a_traceback_and_its_own_code(scene, session):
    session.failing = InputError("first\n  second")
    refused("run", scene, names="first second")
    session.failing = ZeroDivisionError("of all things")
    result = invoke("run", scene, "--json")
    assert (result.exit_code, json.loads(result.stdout)["exit_code"]) == (3, 3)
    assert "Traceback" in result.stderr and "in run_scene" in result.stderr
    session.failing = KeyboardInterrupt()
    result = invoke("run", scene)
    assert (result.exit_code, result.stdout, result.stderr) == (130, "", "error: interrupted\n")


def test_ctrl_c_ends_a_real_process_with_130_and_leaves_nothing(scene):
    code = (
        "import os, sys, types, time; sys.argv[0] = 'modp-ti'; module = types.ModuleType('modp_ti.engine.session')\n"
        "def run_scene(config, console, resumed=None, began=None):\n"
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
    "call",
    [
        *("run", "run a.yaml --nonsense", "run a.yaml --parts 1", "run a.yaml --set", "export out", "check"),
        *("export out --format nonsense", "locate out", "nonsense", "--nonsense"),
    ],
)
def test_wrong_options_end_with_two_in_one_line_and_in_json(call):
    first, *more = call.split()
    result = invoke(first, *more)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
    told = invoke(first, "--json", *more)
    assert told.exit_code == 2 and json.loads(told.stdout)["exit_code"] == 2
    if first in COMMANDS:  # a group has no --json, which is the first mistake then
        assert json.loads(told.stdout)["error"] == result.stderr.removeprefix("error: ").rstrip("\n")


def test_help_on_a_narrow_terminal_names_whole_options():
    assert "Usage:" in invoke().output and "Examples:" in invoke().output
    text = python("-m", "modp_ti.commands.app", "export", "--help", COLUMNS="40").stdout
    for option in ("--format", "--output", "--texture", "--spz-version", "--device"):
        assert f"{option} " in text.replace("\n", " ")
    assert "\u2026" not in text


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches_by_examples_that_the_command_takes(command):
    text = CliRunner().invoke(cli.app, [command, "--help"], terminal_width=200).stdout
    assert "--quiet" in text and ("--json" in text) == (command != "view")  # which has no end to report
    lines = [line.strip() for line in text.partition("Examples:")[2].splitlines() if line.strip()]
    assert len(lines) > 1 and all(f"{line} ".startswith(f"modp-ti {command} ") for line in lines)
    epilog = next(info.epilog for info in cli.app.registered_commands if info.callback.__name__ == command)
    click_app = typer.main.get_command(cli.app)
    calls = [line.split("   (")[0].split(" > ")[0] for line in epilog.splitlines()[1:]]
    for call in (part for line in calls for part in line.split("&&")):
        words = shlex.split(call)
        click_app.commands[words[1]].make_context(words[1], words[2:])  # raises for options that it does not have


def test_the_page_of_commands_names_every_command_option_and_exit_code():
    page = (PROJECT / "docs" / "commands.md").read_text()
    commands = typer.main.get_command(cli.app).commands
    assert list(commands) == COMMANDS
    for name, sub in commands.items():
        assert f"modp-ti {name} " in page
        shown = (parameter for parameter in sub.params if not parameter.hidden)
        for option in (word for parameter in shown for word in parameter.opts if word.startswith("-")):
            assert f"`{option}" in page or option == "--help", f"{name} {option}"
    for code in (0, 1, shared.BAD_INPUT, shared.FAULT, 129, 130, 143):
        assert f"| {code} | " in page


def test_version():
    result = invoke("--version")
    assert (result.exit_code, result.stdout) == (0, f"modp-ti {modp_ti.__version__} ({engine()})\n")


COMPLETED = {
    "modp-ti ": COMMANDS,
    "modp-ti run scene.yaml --q": ["--quiet"],
    "modp-ti export out --format sp": ["splat", "spz", "splat-glb"],
    "modp-ti render out --path ": ["recorded", "smoothed", "orbit"],
    "modp-ti run scene.yaml --set source.sc": ["source.scale=auto"],
    "modp-ti run scene.yaml --set tracker.kind=tu": ["tracker.kind=tum"],
}


def test_the_shell_is_offered_commands_options_and_values_without_waiting():
    """In one process, which loads nothing heavy."""
    heavy = "('taichi', 'quadrants', 'torch', 'open3d', 'pycolmap', 'matplotlib')"
    lines = [line.split(" ") for line in COMPLETED]
    code = (
        "import contextlib, io, json, os, sys; sys.argv[0] = 'modp-ti'\n"
        "from modp_ti.commands.app import app\n"
        "def told(**given):\n"
        "    os.environ.update(given); out = io.StringIO()\n"
        "    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit): app()\n"
        "    return out.getvalue()\n"
        "complete = dict(_MODP_TI_COMPLETE='complete_bash')\n"
        f"offered = [told(COMP_WORDS='\\n'.join(w), COMP_CWORD=str(len(w) - 1), **complete) for w in {lines}]\n"
        f"print(json.dumps([[name for name in {heavy} if name in sys.modules], offered, "
        "told(_MODP_TI_COMPLETE='source_bash')]))"
    )
    loaded, offered, script = json.loads(python("-c", code, _MODP_TI_COMPLETE="complete_bash").stdout)
    assert loaded == [] and [text.split() for text in offered] == list(COMPLETED.values())
    assert "complete -o default -F _modp_ti_completion modp-ti" in script


def test_every_setting_that_is_offered_is_one_that_the_scene_takes(scene):
    offered = [value for value, _ in matching_settings("")]
    keys = dict.fromkeys(value.partition("=")[0] for value in offered)
    assert list(keys) == list(dict.fromkeys(entry.key for entry in documented_keys(SceneConfig)))
    assert len(set(offered)) == len(offered) and "tracker.kind=colmap" in offered
    defaults = [value for value in offered if not value.endswith("=")]
    assert len(defaults) > 100
    for kind, taken in (("colmap", ()), ("klt", ("tracker.loops", "tracker.maps"))):
        base = f"tracker={{kind: {kind}}}"
        given = [
            value for value in defaults if value.startswith(taken) or not value.startswith(("source.vrs", "tracker."))
        ]
        assert load_scene(scene, [base, *given]) == load_scene(scene, [base])
