import numpy as np
import pytest
import torch

from fields.runtime.compiled_kernel import ALONE_BELOW, CompiledKernel, CompiledLoop
from fields.runtime.engine import error_class, ti


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


def test_wrong_types_of_the_first_call_are_refused() -> None:
    with pytest.raises(error_class("RuntimeTypeError")):
        CompiledKernel(Sums().add)("one", 0.5, np.zeros(4))


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
