from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import experiments
import pytest
from experiments import Job, execute

from modp_ti.files.errors import InputError
from tests.patience import PATIENCE


def jobs_of(scene: Path, folder: Path, **overrides: str) -> list[Job]:
    return [
        Job("plain", scene, folder / "plain", overrides),
        Job("none", scene, folder / "none", {"refine.steps": "0"}),
    ]


def test_finished_runs_are_used_again_and_others_are_not(scene: Path, tmp_path: Path, started: list) -> None:
    out = tmp_path / "out"
    said: list[str] = []
    first = execute(jobs_of(scene, out), say=said.append)
    assert [m["online"]["held_out"]["psnr"] for m in first] == [21.0, 22.0]
    assert said == ["[1/2] plain", "[2/2] none"]
    assert execute(jobs_of(scene, out), say=said.append) == first
    assert len(started) == 2
    # Another setting, an interrupted run, another scene file: these run.
    execute(jobs_of(scene, out, seed="7"), say=said.append)
    assert len(started) == 3
    (out / "none" / "metrics.json").unlink()
    execute(jobs_of(scene, out, seed="7"), say=said.append)
    assert len(started) == 4
    scene.write_text(scene.read_text().replace("stop: 9", "stop: 8"))
    execute(jobs_of(scene, out, seed="7"), say=said.append)
    assert len(started) == 6
    execute(jobs_of(scene, out, seed="7"), fresh=True, say=said.append)
    assert len(started) == 8


def test_results_of_another_version_are_not_used(scene: Path, tmp_path: Path, started: list) -> None:
    (job, _) = jobs_of(scene, tmp_path / "out")
    execute([job], say=lambda text: None)
    config = job.folder / "config.yaml"
    config.write_text(config.read_text() + "no_such_key: 1\n")
    assert not job.is_done()


def test_impossible_settings_are_refused_before_the_first_run(scene: Path, tmp_path: Path, started: list) -> None:
    jobs = [*jobs_of(scene, tmp_path), Job("wrong", scene, tmp_path / "wrong", {"refine.stepz": "1"})]
    with pytest.raises(InputError, match=r"refine\.steps"):
        execute(jobs, say=lambda text: None)
    assert started == []


@pytest.mark.slow
def test_a_real_run_that_fails_says_which(scene: Path, tmp_path: Path) -> None:
    # The frames asked for do not exist; the folder's name passes through the command line and YAML unharmed.
    job = Job("beyond the end", scene, scene.parent / "out", {"source.start": "900", "source.stop": "901"})
    with pytest.raises(InputError, match="beyond the end: the run ended with exit code 2"):
        execute([job], say=lambda text: None)


def test_scenes_are_called_as_their_file_or_folder(tmp_path: Path) -> None:
    names = experiments.named_scenes([str(tmp_path / "desk.yaml"), str(tmp_path / "fox" / "scene.yaml")])
    assert list(names) == ["desk", "fox"]
    with pytest.raises(InputError, match="rename"):
        experiments.named_scenes([str(tmp_path / "fox.yaml"), str(tmp_path / "fox" / "scene.yaml")])


def test_settings_of_the_command_line_need_a_value() -> None:
    assert experiments.command_line(["a.b=1", "c=x=y", "a.b=2"]) == {"a.b": "2", "c": "x=y"}
    with pytest.raises(InputError, match=r"--set seed: write it as"):
        experiments.command_line(["seed"])


def test_quality_is_of_the_held_out_frames_where_there_are_some(make_metrics: Callable[..., dict]) -> None:
    section = make_metrics(24.0)["online"]
    assert experiments.quality(section) == {"psnr": 24.0, "ssim": 0.6, "lpips": None}
    section["held_out"] = {"psnr": None, "ssim": None, "lpips": None, "count": 0}
    assert experiments.quality(section)["psnr"] == 25.0


def test_mapping_time_leaves_out_what_is_no_mapping(make_metrics: Callable[..., dict]) -> None:
    assert experiments.mapping_seconds(make_metrics(20.0), refined=True) == 80.0
    assert experiments.mapping_seconds(make_metrics(20.0), refined=False) == 50.0


def test_the_first_third_is_of_the_frames_and_not_of_the_held_out_ones(tmp_path: Path) -> None:
    stages = {"online": 10, "refined": 20}
    lines = ["index,name,held_out,stage,psnr,ssim,lpips"]
    for index in reversed(range(9)):  # held out: 0, 1, 8
        held_out = int(index in (0, 1, 8))
        lines += [f"{index},f{index}.png,{held_out},{stage},{index + base},0.5," for stage, base in stages.items()]
    (tmp_path / "scores.csv").write_text("\n".join(lines) + "\n")
    assert experiments.first_third_psnr(tmp_path, "online") == 10.5
    assert experiments.first_third_psnr(tmp_path, "refined") == 20.5
    (tmp_path / "scores.csv").write_text("\n".join(lines).replace(",1,online", ",0,online"))
    assert experiments.first_third_psnr(tmp_path, "online") == 11.0
    assert experiments.first_third_psnr(tmp_path, "offline") is None
    assert experiments.first_third_psnr(tmp_path / "nowhere", "online") is None


def test_a_mean_over_scenes_needs_every_scene() -> None:
    mean = experiments.mean_figures([{"psnr": 20.0, "lpips": None}, {"psnr": 23.0, "lpips": 0.2}])
    assert mean == {"psnr": 21.5, "lpips": None}


@pytest.mark.slow
@pytest.mark.parametrize("script", ["ablate", "compare"])
def test_the_scripts_explain_themselves_and_end_with_one_line_for_bad_input(script: str, tmp_path: Path) -> None:
    file = Path(__file__).parents[2] / "scripts" / f"{script}.py"

    def call(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(file), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)

    assert "--fresh" in call("--help").stdout
    result = call(str(tmp_path / "none.yaml"), "-o", str(tmp_path / "out"))
    assert result.returncode != 0
    assert result.stderr == f"error: {tmp_path / 'none.yaml'}: no such scene file\n"
