"""Scene files, and runs that are made up instead of computed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tables

from modp_ti.config.scene_file import dump_scene, scene_from_data
from modp_ti.config.settings import SceneConfig
from modp_ti.many.pool import Ended, LocalPool, Resources
from modp_ti.many.task import End
from pipelines.pipeline import breakdown_percent

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


def metrics_of(psnr: float, gaussians: int = 1000, refined: float | None = None, view_renders: int = 5000) -> dict:
    """metrics.json of a run with these held-out PSNRs; those of all frames are 1 dB higher."""

    def section(value: float | None, view_renders: int) -> dict | None:
        if value is None:
            return None
        scores = {"ssim": value / 40, "lpips": None}
        means = {"all": {"psnr": value + 1, "count": 9, **scores}, "held_out": {"psnr": value, "count": 3, **scores}}
        return means | {"gaussians": gaussians, "view_renders": view_renders}

    seconds = {"total": 100.0, "compile": 10.0, "read": 2.0, "track": 5.0, "select": 1.0, "depth": 2.0}
    seconds |= {"occupancy": 1.0, "optimise": 40.0, "refine": 30.0, "evaluate": 5.0, "other": 4.0}
    return {
        "frames": 9,
        "keyframes": 5,
        "gaussians": gaussians,
        "frames_per_second": 0.18,
        "peak_memory_mb": 700.0,
        "breakdown_percent": breakdown_percent(seconds, 50.0),
        "online": section(psnr, 1000),
        "refined": section(refined, view_renders),
        "offline": None,
        "seconds": seconds,
        "snapshots": {"resumed": 0},
    }


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[SceneConfig]:
    """The settings of the runs that were begun; a run only writes its configuration and metrics."""
    configs: list[SceneConfig] = []

    class MadeUp(LocalPool):
        def submit(self, name: str, settings: dict[str, Any], resources: Resources) -> None:
            config = scene_from_data(settings, name)
            configs.append(config)
            config.output.mkdir(parents=True, exist_ok=True)
            metrics = metrics_of(20.0 + len(configs), refined=30.0)
            if config.mode == "offline":
                metrics |= {"online": None, "refined": None, "offline": metrics["refined"]}
            (config.output / "metrics.json").write_text(json.dumps(metrics))
            dump_scene(config, config.output / "config.yaml")
            self._left_out.append(Ended(name, End.done))

    monkeypatch.setattr(tables, "LocalPool", MadeUp)
    return configs


@pytest.fixture
def make_metrics() -> Callable[..., dict]:
    return metrics_of
