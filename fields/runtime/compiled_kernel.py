"""Fast launches of the kernels of a step: no repeated checks in Python, and one thread for small loops.

Taichi 1.7.4 assigns the iterations of a parallel CPU loop to threads in chunks of 512, whatever `block_dim` says, so
that a shorter loop runs on one thread. A loop over n heavy tasks is therefore written as

    for i in range(n * SPREAD):
        if i % SPREAD == 0:
            self._task(i // SPREAD)

with SPREAD = HANDED_OUT // (number of tasks per chunk). The empty iterations cost less than a nanosecond each.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch

from fields.runtime.backend import on_gpu
from fields.runtime.engine import compiled_kernel, engine, owner_of_kernel, running_program

# Below this much work [ns], waking a second thread costs more than it saves. Waking a thread took 50 us on one machine
# and 180 us on another, a virtual one.
ALONE_BELOW = 300_000.0


class CompiledKernel:
    """A kernel of a data-oriented object, launched without the engine's argument checks.

    A launch in Taichi 1.7.4 takes about 50 microseconds of Python, and a step has twenty launches per view. That is
    more than many of these kernels take on a GPU. The first call compiles the kernel and fixes the types of its
    arguments. Later calls only pass integers, floats and contiguous arrays of the same types: NumPy arrays on the CPU,
    or tensors on the kernels' device.
    """

    def __init__(self, kernel: Any, reverse: bool = False, constants: tuple = ()) -> None:
        """Wrap a kernel.

        Args:
            kernel: Bound `ti.kernel` method of a data-oriented object.
            reverse: Launch its gradient kernel.
            constants: Values of its leading arguments, which are templates.
        """
        self._first = kernel.grad if reverse else kernel
        self._kernel = kernel._adjoint if reverse else kernel._primal
        self._constants = constants
        self._owner = owner_of_kernel(kernel)
        self._places: list[Any] = []
        self._program: Any = None
        self._make_context: Any = None
        self._compiled: Any = None

    def __call__(self, *arguments: int | float | np.ndarray | torch.Tensor) -> None:
        if self._compiled is None:
            self._first(*self._constants, *arguments)
            self.compile(*arguments)
            return
        context = self._make_context()
        value: Any  # not narrowed by `kind`, whose comparison is faster than isinstance
        for place, value in zip(self._places, arguments, strict=True):
            kind = value.__class__
            if kind is int:
                context.set_arg_int(place, value)
            elif kind is float:
                context.set_arg_float(place, value)
            elif kind is torch.Tensor:
                context.set_arg_external_array_with_shape(place, value.data_ptr(), value.nbytes, value.shape, 0)
            elif kind is np.ndarray:
                address = value.__array_interface__["data"][0]
                context.set_arg_external_array_with_shape(place, address, value.nbytes, value.shape, 0)
            else:
                raise TypeError(
                    f"argument {self._places.index(place)} of a kernel is a {kind.__name__}, "
                    "which CompiledKernel does not hand over"
                )
        self._program.launch_kernel(self._compiled, context)

    def compile(self, *arguments: int | float | np.ndarray | torch.Tensor) -> None:
        """Compile the kernel for arguments of these types, without launching it."""
        self._places = [engine().place(index) for index in range(len(arguments))]
        self._program = running_program()
        self._make_context, self._compiled = compiled_kernel(self._kernel, (self._owner, *self._constants, *arguments))


class CompiledLoop:
    """A kernel of one parallel loop that runs on the calling thread alone if the loop is short.

    The first argument of the kernel is a template `alone`, which it passes to `ti.loop_config(serialize=alone)`. The
    choice between the two variants does not depend on the number of threads, because their results differ in the last
    bits.
    """

    def __init__(self, kernel: Any, nanoseconds: float, reverse: bool = False) -> None:
        """Wrap a kernel.

        Args:
            kernel: Bound `ti.kernel` method of a data-oriented object.
            nanoseconds: Approximate time of one item on one thread [ns].
            reverse: Launch its gradient kernel.
        """
        self._alone, self._together = (CompiledKernel(kernel, reverse, (alone,)) for alone in (True, False))
        self._most_alone = -1.0 if on_gpu() else ALONE_BELOW / nanoseconds
        self._compiled = False

    def __call__(self, items: int, *arguments: int | float | np.ndarray | torch.Tensor) -> None:
        """Launch the kernel over `items` items."""
        chosen = self._alone if items <= self._most_alone else self._together
        chosen(*arguments)
        if not self._compiled and self._most_alone >= 0.0:
            # Compile both variants now, so that a run does not stop to compile when the map outgrows one thread.
            (self._together if chosen is self._alone else self._alone).compile(*arguments)
        self._compiled = True


HANDED_OUT = 512


class AsyncReadback:
    """A snapshot of a small tensor that is read later.

    The copy into pinned memory is queued behind the kernels launched so far. Later writes to the tensor do not affect
    it. Pinned memory and events are used again once they have been read, since making them anew took the host twice as
    long as the copy.
    """

    _spare: ClassVar[dict[tuple[torch.dtype, torch.Size], list[tuple[torch.Tensor, torch.cuda.Event]]]] = {}

    def __init__(self, tensor: torch.Tensor) -> None:
        self._values: np.ndarray | None = None
        if not tensor.is_cuda:
            self._values = tensor.numpy().copy()
            return
        self._kind = (tensor.dtype, tensor.shape)
        spare = self._spare.setdefault(self._kind, [])
        if spare:
            self._host, self._event = spare.pop()
        else:
            self._host = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
            self._event = torch.cuda.Event()
        self._host.copy_(tensor, non_blocking=True)
        self._event.record()

    def numpy(self) -> np.ndarray:
        """Return the values. Waits for the copy if it has not finished."""
        if self._values is None:
            self._event.synchronize()
            self._values = np.array(self._host.numpy())
            self._spare[self._kind].append((self._host, self._event))
        return self._values
