"""The paper's tables: which runs they are made of, what they show, and what is not run again."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tables
from tables import Figures

from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError


@pytest.mark.parametrize("variant", list(tables.VARIANTS))
def test_every_variant_changes_what_it_names_and_nothing_else(scene: Path, variant: str) -> None:
    def flat(overrides: dict[str, str]) -> dict[str, Any]:
        settings = load_scene(scene, [f"{key}={value}" for key, value in overrides.items()]).mapping.model_dump()
        return {f"mapping.{a}.{b}": v for a, of in settings.items() if isinstance(of, dict) for b, v in of.items()}

    full, changed = flat({}), flat(tables.VARIANTS[variant])
    assert {key for key in full if full[key] != changed[key]} == set(tables.VARIANTS[variant])
    views = [sum(of[f"mapping.views.{bank}_views"] for bank in ("local", "global")) for of in (full, changed)]
    assert views[0] == views[1], "each step keeps its budget"


def test_the_ablations_are_those_of_the_paper() -> None:
    def of_scene(shift: float, third: float | None) -> dict[str, Figures]:
        return {
            name: {"psnr": 20 + i + shift, "ssim": 0.8, "lpips": None, "gaussians": 1e4 * (i + 1)}
            | {"first_third_psnr": third}
            for i, name in enumerate([*tables.VARIANTS, tables.OTHER_TRACKER])
        }

    text = tables.ablation_report({"desk": of_scene(0.0, 19.5), "fox": of_scene(1.0, None)})
    mean, _, desk = text.partition("## desk")
    for row in ("w/o EC | 20.50 | 0.800 | – | 10,000", "w/o EC & MOHV | 22.50 | 0.800 | – | 30,000"):
        assert f"| {row} |" in mean
    for row in ("w/o global cams | 23.50 | 0.800 | – | –", "w/o cam refinement | 24.50 | 0.800 | – | –"):
        assert f"| {row} |" in mean
    assert "| other tracker | 26.50 | 0.800 | – | 70,000 |" in mean and mean.count("| full | 25.50 |") == 3
    assert "| w/o global cams | 23.00 | 0.800 | – | 19.50 |" in desk
    two = tables.ablation_report({"desk": {v: f for v, f in of_scene(0.0, 1.0).items() if v in ("w/o EC", "full")}})
    assert "w/o EC" in two and "w/o MOHV" not in two and "Global consistent" not in two


def call(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> None:
    monkeypatch.setattr(sys, "argv", ["tables.py", *map(str, arguments)])
    tables.main()


def test_ablations_are_run_once_and_what_is_printed_is_written(
    scene: Path, tmp_path: Path, started: list, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "other.yaml").write_text(scene.read_text() + "seed: 5\n")
    out = tmp_path / "out"
    arguments = ["ablate", scene, "-o", out, "--tracker", tmp_path / "other.yaml", "--set", "threads=1"]
    call(monkeypatch, *arguments)
    configs = {config.output.name: config for config in started}
    assert len(started) == len(configs) == len(tables.VARIANTS) + 1
    assert {config.refine.steps for config in started} == {0} and {config.threads for config in started} == {1}
    without = [name for name, config in configs.items() if not config.mapping.voxels.enabled]
    assert sorted(without) == ["without-ec-mohv", "without-mohv"]
    assert configs["other-tracker"].seed == 5
    assert (out / "ablation.md").read_text() == capsys.readouterr().out
    assert list(json.loads((out / "ablation.json").read_text())) == [scene.parent.name]

    call(monkeypatch, *arguments)
    assert len(started) == len(configs), "finished runs are used again"
    (out / scene.parent.name / "full" / "metrics.json").unlink()
    call(monkeypatch, *arguments, "--only", "full")
    assert len(started) == len(configs) + 1
    call(monkeypatch, *arguments, "--only", "full", "--fresh")
    assert len(started) == len(configs) + 3, "with the other tracker"


def test_the_comparison_shows_what_each_map_cost(
    scene: Path, tmp_path: Path, started: list, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    call(monkeypatch, "compare", scene, "-o", tmp_path / "out", "--steps", "1000", "200", "1000")
    assert [config.refine.steps for config in started[:2]] == [1000, 200]
    assert (started[2].mode, started[2].offline.steps) == ("offline", 5000), "as many views as the online run"
    assert (tmp_path / "out" / "comparison.md").read_text() == (text := capsys.readouterr().out)
    assert "| online | 21.00 | 0.525 | – | 0 | 1,000 | 1,000 | 50 |" in text
    assert "| online + 200 steps | 30.00 | 0.750 | – | 200 | 1,000 | 5,000 | 80 |" in text
    assert "| offline 3DGS | 30.00 | 0.750 | – | 5,000 | 1,000 | 5,000 | 80 |" in text
    assert f"| {scene.parent.name} | 80.00 | 2.00 | 4.00 | 2.00 | 12.00 | 0.18 |" in text


def test_impossible_settings_are_refused_before_the_first_run(
    scene: Path, tmp_path: Path, started: list, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    for arguments, said in (
        (["--set", "refine.stepz=1"], "refine.steps"),
        (["--set", "seed"], "--set seed"),
        (["--tracker", "a.yaml", "b.yaml"], "--tracker"),
    ):
        with pytest.raises(SystemExit) as ended:
            call(monkeypatch, "ablate", scene, "-o", tmp_path / "out", *arguments)
        error = capsys.readouterr().err
        assert ended.value.code == 2 and said in error and error.count("\n") == 1
    with pytest.raises(InputError, match="rename"):
        tables.named_scenes([str(scene), str(scene)])
    assert started == []


def test_figures_are_of_held_out_frames_or_else_of_all(make_metrics: Callable[..., dict], tmp_path: Path) -> None:
    section = make_metrics(24.0)["online"]
    assert tables.quality(section) == {"psnr": 24.0, "ssim": 0.6, "lpips": None}
    section["held_out"]["count"] = 0
    assert tables.quality(section)["psnr"] == 25.0
    lines = ["index,name,held_out,stage,psnr,ssim,lpips,detail"]
    lines += [f"{i},f{i}.png,{int(i in (0, 1, 8))},online,{10 + i},0.5,," for i in reversed(range(9))]
    (tmp_path / "scores.csv").write_text("\n".join(lines) + "\n")
    assert tables.first_third_psnr(tmp_path / "scores.csv", "online") == 10.5, "of the first three frames"
    (tmp_path / "scores.csv").write_text("\n".join(lines).replace(",1,online", ",0,online"))
    assert tables.first_third_psnr(tmp_path / "scores.csv", "online") == 11.0
    assert tables.first_third_psnr(tmp_path / "scores.csv", "offline") is None
    assert tables.first_third_psnr(tmp_path / "nowhere.csv", "online") is None


@pytest.mark.slow
def test_a_run_that_fails_is_named(scene: Path, tmp_path: Path) -> None:
    run = tables.settings_of(scene, tmp_path / "out", {"source.start": "900", "source.stop": "901"})
    with pytest.raises(InputError, match="beyond-the-end"):
        tables.execute({("scene", "beyond the end"): run}, tmp_path)
