"""The examples in the docstrings of the public names run as they stand."""

from __future__ import annotations

import inspect
import re
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch

import modp_ti
from tests.pipelines.wall import CAMERA, frame, pose

pytestmark = pytest.mark.slow

# What an example leaves behind, later ones use. Those that map a whole scene are run by the tests of docs/examples,
# and those that need a finished run by the tests of what they show.
FIRST = ["initialise", "Mapper", "write_splats", "PoseCorrection", "RefineSettings", "OnlineMapper", "refine"]
THEN = ["GaussianField", "Renderer", "rasterize"]
# Taichi 1.7.4 has room for the fields of one map in a process.
NEW_FIELDS = ["Mapper", "OnlineMapper", "GaussianField", "rasterize", "MappingSettings", "OccupancyVoxels"]
WHOLE_SCENES = ["SceneConfig", "InputError", "load_scene", "open_tracker", "run_scene", "Location", "Locator"]


def example(name: str) -> str:
    """The code of a docstring's example, without the sentence that may lead to it."""
    text = inspect.getdoc(getattr(modp_ti, name))
    found = re.search(r"^Examples?:\n((?:    .*\n?|\n)+)", text or "", re.MULTILINE)
    assert found, f"{name} has no example"
    return textwrap.dedent(textwrap.dedent(found[1]).split(":\n\n", 1)[-1])


@pytest.mark.parametrize("name", modp_ti._HOMES)
def test_every_example_names_what_there_is(name: str) -> None:
    code = example(name)
    compile(code, name, "exec")
    for attribute in re.findall(r"modp_ti\.(\w+)", code):
        assert attribute in modp_ti.__all__
    assert f"{name}" in code or name in ("InputError", "PoseCorrection")


def test_the_examples_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = {"modp_ti": modp_ti, "np": np, "torch": torch, "frames": [frame(i) for i in range(2)]}
    names |= {"camera": CAMERA, "T_camera_world": pose(1)}
    others = sorted(set(modp_ti._HOMES) - {*FIRST, *THEN, *WHOLE_SCENES})
    for name in FIRST + THEN + others:
        if name in NEW_FIELDS:
            modp_ti.initialise("cpu")
        exec(compile(example(name), f"example of {name}", "exec"), names)
    assert names["report"].keyframes > 1
    assert names["tensors"]["position"].grad.abs().max() > 0
    assert names["kept"].tolist() == [True, False]
