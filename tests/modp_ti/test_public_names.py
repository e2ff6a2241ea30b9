"""`import modp_ti` loads nothing that takes time, and has the same names for a program as for a type checker."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import modp_ti

TREE = ast.parse(Path(modp_ti.__file__).read_text())


def seen_by_type_checkers() -> dict[str, str]:
    """Names that are imported under `if TYPE_CHECKING`, with the module of each."""
    block = next(node for node in TREE.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    return {alias.name: node.module for node in block.body for alias in node.names}


def test_type_checkers_see_the_names_that_there_are():
    assert seen_by_type_checkers() == modp_ti._HOMES
    assert set(modp_ti.__all__) == {*modp_ti._HOMES, "__version__"}


@pytest.mark.parametrize("name", modp_ti._HOMES)
def test_every_name_is_what_its_home_has(name):
    assert getattr(modp_ti, name) is getattr(importlib.import_module(modp_ti._HOMES[name]), name)


def test_a_name_that_there_is_not_is_an_error():
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = modp_ti.nothing


def test_nothing_is_loaded_before_it_is_asked_for():
    heavy = "{'taichi', 'quadrants', 'torch', 'numpy', 'pydantic', 'cv2'}"
    code = f"import modp_ti, sys; print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
