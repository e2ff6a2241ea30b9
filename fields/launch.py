"""`Launch`: a kernel that a step calls again and again, without the checks that Taichi makes in Python every time."""

from __future__ import annotations

from typing import Any

import numpy as np
import taichi as ti
import torch

__all__ = ["Launch"]


class Launch:
    """A kernel of a data-oriented object. The first call compiles it, and settles the types of its arguments.

    Taichi 1.7.4 takes some 50 microseconds of Python for a launch, and a step has twenty of them a view: more than
    many of these kernels take on a GPU. Later calls here only hand over integers, floats and contiguous arrays (NumPy's
    on the CPU, tensors that lie where kernels run), which must have the types of the first call's.
    """

    def __init__(self, kernel: Any, reverse: bool = False) -> None:
        """reverse: launch its gradient kernel."""
        self._first = kernel.grad if reverse else kernel
        self._kernel = kernel._adjoint if reverse else kernel._primal
        self._owner = kernel._kernel_owner
        self._program: Any = None
        self._make_context: Any = None
        self._compiled: Any = None

    def __call__(self, *arguments: int | float | np.ndarray | torch.Tensor) -> None:
        if self._compiled is None:
            self._first(*arguments)
            self._settle(arguments)
            return
        context = self._make_context()
        for place, value in enumerate(arguments):
            kind = value.__class__
            if kind is int:
                context.set_arg_int((place,), value)
            elif kind is float:
                context.set_arg_float((place,), value)
            elif kind is torch.Tensor:
                context.set_arg_external_array_with_shape((place,), value.data_ptr(), value.nbytes, value.shape, 0)
            elif kind is np.ndarray:
                address = value.__array_interface__["data"][0]
                context.set_arg_external_array_with_shape((place,), address, value.nbytes, value.shape, 0)
            else:
                raise TypeError(f"argument {place} of a kernel is a {kind.__name__}, which Launch does not hand over")
        self._program.launch_kernel(self._compiled, context)

    def _settle(self, arguments: tuple) -> None:
        program = ti.lang.impl.get_runtime().prog
        compiled = self._kernel.compiled_kernels[self._kernel.ensure_compiled(self._owner, *arguments)]
        self._program = program
        self._make_context = compiled.make_launch_context
        self._compiled = program.compile_kernel(program.config(), program.get_device_caps(), compiled)
