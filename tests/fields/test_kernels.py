"""The engine that compiles kernels, its sources, and fast launches."""

import inspect
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch

from fields.runtime import engine as module
from fields.runtime.compiled_kernel import ALONE_BELOW, CompiledKernel, CompiledLoop
from fields.runtime.engine import ENGINES, EngineError, engine, error_class, part, ti
from fields.runtime.kernel_sources import answer_quickly
from pipelines.render.cpu.projection import Projection

PROJECT = Path(__file__).resolve().parents[2]


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


def test_the_lines_of_a_function_are_those_of_its_file():
    answer_quickly()
    function = Projection.project._primal.func
    reader = part(engine().source_readers[-1])
    assert reader.getsourcelines(function) == inspect.getsourcelines(function)
    assert reader.getsourcefile(function) == inspect.getsourcefile(function)


def test_a_fault_in_a_kernel_is_still_shown_with_its_line():
    answer_quickly()

    @ti.kernel
    def faulty():
        x = undefined_name + 1  # noqa: F821, F841

    try:
        faulty()
    except error_class("CompilationError") as error:
        assert "x = undefined_name + 1" in str(error) and "^^^^" in str(error)
    else:
        raise AssertionError("compiled")


def test_a_kernel_is_parsed_once():
    """Quadrants would do it twice. Both forms of a kernel with a template argument are parsed."""
    answer_quickly()
    parsed = []

    def note(value):
        parsed.append(value)
        return value

    @ti.kernel
    def twice(of: ti.template()) -> ti.i32:
        return 2 * ti.static(note(of))

    assert [twice(3), twice(4), twice(3)] == [6, 8, 6]
    assert parsed == [3, 4]


@ti.data_oriented
class Sums:
    def __init__(self) -> None:
        self.x = ti.field(ti.f32, 4, needs_grad=True)
        self.y = ti.field(ti.f32, 4, needs_grad=True)

    @ti.kernel
    def add(self, shift: ti.i32, factor: ti.f32, a: ti.types.ndarray(dtype=ti.f64, ndim=1)):
        for i in range(4):
            self.x[i] = shift + factor * a[i]

    @ti.kernel
    def read(self, out: ti.types.ndarray(dtype=ti.f32, ndim=2)):
        for i in range(4):
            out[0, i] = self.x[i]

    @ti.kernel
    def square(self):
        for i in range(4):
            self.y[i] = self.x[i] * self.x[i]

    @ti.kernel
    def tell(self, alone: ti.template(), out: ti.types.ndarray(dtype=ti.f32, ndim=1)):
        ti.loop_config(serialize=alone)
        for i in range(4):
            self.y[i] = self.x[i]
            out[i] = ti.select(alone, 1.0, 2.0)

    @ti.kernel
    def cube(self, alone: ti.template()):
        ti.loop_config(serialize=alone)
        for i in range(4):
            self.y[i] = self.x[i] * self.x[i] * self.x[i]


def test_every_call_takes_its_own_arguments() -> None:
    """The first, which the engine checks, and those after it; arrays of NumPy and tensors, of any size."""
    sums = Sums()
    add, read = CompiledKernel(sums.add), CompiledKernel(sums.read)
    out = torch.zeros((2, 4))
    for call, array in enumerate((np.arange(4.0), np.arange(9.0), torch.arange(4, dtype=torch.float64))):
        add(call, 0.5, array)
        np.testing.assert_allclose(sums.x.to_numpy(), call + 0.5 * np.arange(4))
        read(out)
        np.testing.assert_allclose(out[0], call + 0.5 * np.arange(4))


def test_objects_of_one_class_keep_apart() -> None:
    first, second = Sums(), Sums()
    launches = [CompiledKernel(first.add), CompiledKernel(second.add)]
    for value in (1, 2):
        for k, launch in enumerate(launches):
            launch(10 * k + value, 0.0, np.zeros(4))
    assert (first.x[0], second.x[0]) == (2, 12)


def test_a_gradient_kernel_is_launched_as_well() -> None:
    sums = Sums()
    sums.x.from_numpy(np.arange(4, dtype=np.float32))
    backward = CompiledKernel(sums.square, reverse=True)
    for weight in (1.0, 3.0):
        sums.x.grad.fill(0.0)
        sums.y.grad.fill(weight)
        backward()
        np.testing.assert_allclose(sums.x.grad.to_numpy(), 2 * weight * np.arange(4))


def test_wrong_types_of_a_later_call_are_refused() -> None:
    add = CompiledKernel(Sums().add)
    add(1, 0.5, np.zeros(4))
    with pytest.raises(TypeError, match="argument 0"):
        add(np.int64(1), 0.5, np.zeros(4))


def test_little_work_is_done_by_the_calling_thread_and_much_by_all() -> None:
    sums, out = Sums(), np.zeros(4, dtype=np.float32)
    tell = CompiledLoop(sums.tell, nanoseconds=10.0)
    at_most = int(ALONE_BELOW / 10.0)
    for items, expected in ((at_most, 1.0), (at_most + 1, 2.0), (1, 1.0), (10**9, 2.0)):
        tell(items, out)
        assert (out == expected).all()


@pytest.mark.parametrize("items", [1, 10**9])
def test_both_ways_give_the_gradient(items: int) -> None:
    sums = Sums()
    sums.x.from_numpy(np.arange(4, dtype=np.float32))
    backward = CompiledLoop(sums.cube, nanoseconds=1.0, reverse=True)
    for _ in range(2):
        sums.x.grad.fill(0.0)
        sums.y.grad.fill(1.0)
        backward(items)
        np.testing.assert_allclose(sums.x.grad.to_numpy(), 3 * np.arange(4) ** 2)
