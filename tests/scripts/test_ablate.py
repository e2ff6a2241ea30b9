from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import ablate
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.files.errors import InputError


@pytest.mark.parametrize("variant", list(ablate.VARIANTS))
def test_every_variant_changes_what_it_names_and_nothing_else(scene: Path, variant: str) -> None:
    def flat(overrides: dict[str, str]) -> dict[str, object]:
        settings = load_scene(scene, [f"{key}={value}" for key, value in overrides.items()]).mapping.model_dump()
        return {f"mapping.{a}.{b}": v for a, of in settings.items() if isinstance(of, dict) for b, v in of.items()}

    full, changed = flat({}), flat(ablate.VARIANTS[variant])
    assert {key for key in full if full[key] != changed[key]} == set(ablate.VARIANTS[variant])


def test_without_global_views_the_budget_of_views_stays(scene: Path) -> None:
    def views(variant: str) -> int:
        overrides = [f"{key}={value}" for key, value in ablate.VARIANTS[variant].items()]
        settings = load_scene(scene, overrides).mapping.views
        return settings.local_views + settings.global_views

    assert views("w/o global cams") == views(ablate.FULL)


def test_the_tables_are_those_of_the_paper() -> None:
    def of_scene(shift: float, third: float | None) -> dict:
        names = [*ablate.VARIANTS, ablate.OTHER_TRACKER]
        return {
            name: {
                "psnr": 20.0 + i + shift,
                "ssim": 0.8,
                "lpips": None,
                "gaussians": 10_000 * (i + 1),
                "first_third_psnr": third,
            }
            for i, name in enumerate(names)
        }

    text = ablate.report({"desk": of_scene(0.0, 19.5), "fox": of_scene(1.0, None)})
    assert text.startswith(
        """\
# Ablations

Held-out frames; all frames where none is held out.

## Mean of 2 scenes

| Gaussian management | PSNR | SSIM | LPIPS | # Gaussians |
|---|---|---|---|---|
| w/o EC | 20.50 | 0.800 | – | 10,000 |
| w/o MOHV | 21.50 | 0.800 | – | 20,000 |
| w/o EC & MOHV | 22.50 | 0.800 | – | 30,000 |
| full | 25.50 | 0.800 | – | 60,000 |

| Global consistent optimisation | PSNR | SSIM | LPIPS | held-out PSNR, first third |
|---|---|---|---|---|
| w/o global cams | 23.50 | 0.800 | – | – |
| w/o cam refinement | 24.50 | 0.800 | – | – |
| full | 25.50 | 0.800 | – | – |

| Tracking | PSNR | SSIM | LPIPS | # Gaussians |
|---|---|---|---|---|
| other tracker | 26.50 | 0.800 | – | 70,000 |
| full | 25.50 | 0.800 | – | 60,000 |

## desk
"""
    )
    assert "| w/o global cams | 23.00 | 0.800 | – | 19.50 |" in text
    alone = ablate.report({"desk": {v: f for v, f in of_scene(0.0, 19.5).items() if v != ablate.OTHER_TRACKER}})
    assert alone.count("## ") == 1
    assert "Tracking" not in alone


def test_the_script_runs_every_variant_and_writes_what_it_prints(
    scene: Path, tmp_path: Path, started: list, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    other = tmp_path / "other.yaml"
    other.write_text(scene.read_text() + "seed: 5\n")
    out = tmp_path / "out"
    arguments = ["ablate.py", str(scene), "-o", str(out), "--tracker", str(other), "--set", "threads=1"]
    monkeypatch.setattr(sys, "argv", arguments)
    ablate.main()
    assert len(started) == len(ablate.VARIANTS) + 1
    folders = sorted(p.parent for p in out.glob("*/*/metrics.json"))
    assert len(folders) == len(started)
    configs = {folder.name: load_scene(folder / "config.yaml") for folder in folders}
    assert {config.refine.steps for config in configs.values()} == {0}
    assert {config.threads for config in configs.values()} == {1}
    assert [name for name, config in configs.items() if not config.mapping.voxels.enabled] == [
        "without-ec-mohv",
        "without-mohv",
    ]
    assert configs["other-tracker"].seed == 5
    assert (out / "ablation.md").read_text() == capsys.readouterr().out
    assert list(json.loads((out / "ablation.json").read_text())) == [scene.parent.name]
    ablate.main()
    assert len(started) == len(folders)


def test_variants_that_are_not_asked_for_are_neither_run_nor_shown(scene: Path, tmp_path: Path) -> None:
    jobs = ablate.plan({"a": scene}, tmp_path, {}, variants=["w/o EC", ablate.FULL])
    assert list(jobs["a"]) == ["w/o EC", ablate.FULL]
    row = dict.fromkeys(("psnr", "ssim", "lpips", "gaussians", "first_third_psnr"), 1.0)
    text = ablate.report({"a": dict.fromkeys(jobs["a"], row)})
    assert "w/o EC" in text and "w/o MOHV" not in text and "Global consistent" not in text


def test_another_tracker_is_named_for_every_scene_or_none(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="one file for each of the 2 scenes, got 1"):
        ablate.plan({"a": scene, "b": scene}, tmp_path, {}, ["other.yaml"])


def test_a_refined_run_shows_its_refined_map(make_metrics: Callable[..., dict], tmp_path: Path) -> None:
    assert ablate.summary(make_metrics(24.0), tmp_path)["psnr"] == 24.0
    assert ablate.summary(make_metrics(24.0, refined=26.0), tmp_path)["psnr"] == 26.0
