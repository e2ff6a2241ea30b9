"""One module alone knows which of the two engines compiles the kernels."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from fields.runtime import engine as module
from fields.runtime.engine import ENGINES, EngineError, engine

PROJECT = Path(__file__).resolve().parents[3]
DOOR = PROJECT / "fields" / "runtime" / "engine.py"


def chosen(monkeypatch: pytest.MonkeyPatch, asked: str | None, *installed: str) -> str:
    """The package that is chosen with these installed and MODP_ENGINE set to `asked`."""
    monkeypatch.setattr(module, "find_spec", lambda name: name in installed or None)
    monkeypatch.delenv("MODP_ENGINE", raising=False)
    if asked is not None:
        monkeypatch.setenv("MODP_ENGINE", asked)
    return engine.__wrapped__().package


@pytest.mark.parametrize(
    ("asked", "installed", "package"),
    [
        (None, ("taichi", "quadrants"), "taichi"),
        ("", ("taichi", "quadrants"), "taichi"),
        (None, ("quadrants",), "quadrants"),
        ("quadrants", ("taichi", "quadrants"), "quadrants"),
        ("taichi", ("taichi", "quadrants"), "taichi"),
    ],
)
def test_taichi_comes_first_and_quadrants_where_it_is_missing_or_asked_for(
    monkeypatch: pytest.MonkeyPatch, asked: str | None, installed: tuple[str, ...], package: str
) -> None:
    assert chosen(monkeypatch, asked, *installed) == package


@pytest.mark.parametrize(
    ("asked", "installed", "complaint", "remedy"),
    [
        ("numba", ("taichi", "quadrants"), "MODP_ENGINE=numba is no engine", "set it to taichi or quadrants"),
        ("quadrants", ("taichi",), "MODP_ENGINE=quadrants, which is not installed", "pip install quadrants"),
        ("taichi", ("quadrants",), "MODP_ENGINE=taichi, which is not installed", "unset MODP_ENGINE"),
        (None, (), "neither Taichi nor Quadrants is installed", "pip install quadrants"),
    ],
)
def test_an_engine_that_is_not_there_is_said_in_one_line_with_the_way_out(
    monkeypatch: pytest.MonkeyPatch, asked: str | None, installed: tuple[str, ...], complaint: str, remedy: str
) -> None:
    with pytest.raises(EngineError) as error:
        chosen(monkeypatch, asked, *installed)
    said = str(error.value)
    assert said.startswith(complaint) and remedy in said and "\n" not in said


def test_the_commands_say_an_unknown_engine_in_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "modp_ti.commands.app", "check", "demo/scene.yaml"],
        cwd=PROJECT, env=os.environ | {"MODP_ENGINE": "numba"}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith("error: MODP_ENGINE=numba is no engine") and done.stderr.count("\n") == 1


@pytest.mark.parametrize("package", [name for name in ENGINES if find_spec(name)])
def test_asking_for_an_engine_does_not_load_it_and_its_language_does(package: str) -> None:
    code = (
        "import sys; from fields.runtime.engine import engine; "
        "print(engine().package, [name for name in ('taichi', 'quadrants') if name in sys.modules]); "
        "from fields.runtime.engine import ti; "
        "print([name for name in ('taichi', 'quadrants') if name in sys.modules], ti.f32)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=PROJECT, env=os.environ | {"MODP_ENGINE": package}, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.splitlines() == [f"{package} []", f"['{package}'] f32"]  # and no greeting


def test_no_other_module_imports_an_engine() -> None:
    sources = [
        path
        for name in ("fields", "pipelines", "modp_ti", "scripts", "tests")
        for path in (PROJECT / name).rglob("*.py")
    ]
    assert DOOR in sources and len(sources) > 300
    importing = set()
    for path in sources:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if {name.partition(".")[0] for name in names} & set(ENGINES):
                importing.add(path)
    assert importing == {DOOR}


def test_attributes_of_data_oriented_objects_are_looked_up_by_python_itself(taichi_on_the_cpu: None) -> None:
    """A function in Python for every attribute took the host 0.3 ms a step."""

    @module.ti.data_oriented
    class Doubled:
        def __init__(self) -> None:
            self.x = module.ti.field(module.ti.f32, shape=2, needs_grad=True)
            self.y = module.ti.field(module.ti.f32, shape=2, needs_grad=True)

        @module.ti.kernel
        def double(self):
            for i in self.x:
                self.y[i] = 2.0 * self.x[i]

        @property
        def total(self) -> float:
            return float(self.y.to_numpy().sum())

    @module.ti.data_oriented
    class Inherited(Doubled):
        pass

    assert Inherited.__getattribute__ is object.__getattribute__
    doubled = Inherited()
    doubled.x[0], doubled.y.grad[0] = 3.0, 5.0
    doubled.double()
    doubled.double.grad()
    assert (doubled.total, doubled.x.grad[0]) == (6.0, 10.0)
