"""Scene files, and runs that are made up instead of computed."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from modp_ti.config.scene_file import dump_scene, load_scene
from pipelines.stopwatch import breakdown_percent

DEMO = Path(__file__).resolve().parents[2] / "demo" / "room.mp4"
SCENE = f"""
source:  {{path: {json.dumps(str(DEMO))}, scale: 0.25, holdout: 4, stop: 9}}
tracker: {{kind: klt}}
output:  out
device:  cpu
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene file in a folder whose name needs quoting in YAML."""
    file = tmp_path / "a room: #1, [small]" / "scene.yaml"
    file.parent.mkdir()
    file.write_text(SCENE)
    return file


def metrics_of(
    psnr: float, gaussians: int = 1000, refined: float | None = None, view_renders: int = 5000, **more: object
) -> dict:
    """metrics.json of a run with these held-out PSNRs; those of all frames are 1 dB higher."""

    def section(value: float | None, view_renders: int) -> dict | None:
        if value is None:
            return None
        scores = {"ssim": value / 40, "lpips": None}
        means = {"all": {"psnr": value + 1, "count": 9, **scores}, "held_out": {"psnr": value, "count": 3, **scores}}
        return means | {"gaussians": gaussians, "view_renders": view_renders}

    seconds = {"total": 100.0, "compile": 10.0, "read": 2.0, "track": 5.0, "select": 1.0, "depth": 2.0}
    seconds |= {"occupancy": 1.0, "optimise": 40.0, "refine": 30.0, "evaluate": 5.0, "other": 4.0}
    metrics = {"frames": 9, "keyframes": 5, "gaussians": gaussians, "frames_per_second": 0.18}
    metrics |= {
        "peak_memory_mb": 700.0,
        "breakdown_percent": breakdown_percent(seconds, 50.0),
        "online": section(psnr, 1000),
    }
    return metrics | {"refined": section(refined, view_renders), "seconds": seconds} | more


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The command lines of the runs that were started; a run only writes its configuration and metrics."""
    commands: list[list[str]] = []

    def run(command: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        assert command[1:3] == ["-m", "modp_ti.run"]
        overrides = command[5::2]
        assert command[4::2] == ["--set"] * len(overrides)
        config = load_scene(command[3], overrides)
        config.output.mkdir(parents=True, exist_ok=True)
        (config.output / "metrics.json").write_text(json.dumps(metrics_of(20.0 + len(commands), refined=30.0)))
        dump_scene(config, config.output / "config.yaml")
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(subprocess, "run", run)
    return commands


@pytest.fixture
def make_metrics() -> Callable[..., dict]:
    return metrics_of
