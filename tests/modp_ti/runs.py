"""Runs as a user starts them: in processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.patience import PATIENCE

FILES = [
    ".modp-ti",
    "colmap",
    "config.yaml",
    "frames.json",
    "metrics.json",
    "renders",
    "report.html",
    "scores.csv",
    "splats.ply",
    "trajectory.txt",
]
# Of the room's recording: nine frames of 80x60.
SHORT_RUN = """
source:  {path: images, holdout: 4, fps: 10}
tracker: {kind: colmap, path: sparse/0}
output:  out
device:  cpu
seed:    3
mapping: {optimise: {steps: 8}, densify: {warm_up: 3}}
refine:  {steps: 20}
"""


def run(scene: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A run on a machine whose torch has no weights in its cache."""
    return _called(scene, "modp_ti.run", str(scene), *arguments)


def check(scene: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The same of `modp-ti check`."""
    return _called(scene, "modp_ti.commands.app", "check", str(scene), *arguments)


def _called(scene: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", *arguments]
    environment = {**os.environ, "TORCH_HOME": str(scene.parent / "no-torch")}
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False, env=environment)


def finished_run(folder: Path, scene: str, said: str) -> Path:
    """The output folder of a run of the scene file's text, which says `said` on the terminal."""
    file = folder / "scene.yaml"
    file.write_text(scene)
    result = run(file)
    assert result.returncode == 0, result.stderr
    assert said in result.stderr
    assert result.stdout == f"written to {folder.resolve() / 'out'}\n"
    return folder / "out"
