"""What Taichi is told of sources is what it would have found out by itself."""

import inspect
import textwrap

import taichi as ti
from hypothesis import given
from hypothesis import strategies as st
from taichi.lang import kernel_impl
from taichi.lang.ast import ast_transformer_utils

from fields.runtime.kernel_sources import QuickWrapper, answer_quickly
from pipelines.render.cpu.projection import Projection


@given(st.text(max_size=200), st.integers(1, 100))
def test_a_text_is_folded_as_the_library_folds_it(text, width):
    assert QuickWrapper(width=width).wrap(text) == textwrap.TextWrapper(width=width).wrap(text)


@given(st.integers(0, 40), st.text(alphabet="abc =+^ \t", max_size=90))
def test_a_line_of_code_is_folded_as_the_library_folds_it(indent, code):
    line = " " * indent + code
    assert QuickWrapper(width=80).wrap(line) == textwrap.TextWrapper(width=80).wrap(line)


def test_the_lines_of_a_function_are_those_of_its_file():
    answer_quickly()
    function = Projection.project._primal.func
    assert kernel_impl.getsourcelines(function) == inspect.getsourcelines(function)
    assert kernel_impl.getsourcefile(function) == inspect.getsourcefile(function)


def test_a_fault_in_a_kernel_is_still_shown_with_its_line():
    assert ast_transformer_utils.TextWrapper is QuickWrapper

    @ti.kernel
    def faulty():
        x = undefined_name + 1  # noqa: F821, F841

    try:
        faulty()
    except ti.TaichiCompilationError as error:
        assert "x = undefined_name + 1" in str(error) and "^^^^" in str(error)
    else:
        raise AssertionError("compiled")
