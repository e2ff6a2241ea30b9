"""What the engine is told of sources is what it would have found out by itself."""

import inspect

from fields.runtime.engine import engine, error_class, part, ti
from fields.runtime.kernel_sources import answer_quickly
from pipelines.render.cpu.projection import Projection


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


def test_kernels_of_classes_are_told_from_functions():
    answer_quickly()

    @ti.data_oriented
    class Counter:
        def __init__(self) -> None:
            self.sum = 3

        @ti.kernel
        def total(self) -> ti.i32:
            return 2 * self.thrice(self.sum)

        @ti.func
        def thrice(self, x):
            return x * self.sum

    @ti.func
    def square(x):
        return x * x

    @ti.kernel
    def four() -> ti.i32:
        return square(2)

    assert part("lang.kernel_impl")._inside_class.__module__ == "fields.runtime.kernel_sources"
    assert Counter().total() == 18
    assert four() == 4


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
