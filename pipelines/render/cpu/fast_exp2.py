"""A power of two that LLVM can vectorise. A call to libm would make every compositing loop scalar."""
# pyright: reportInvalidTypeForm=false

from fields.runtime.engine import ti

LOG2E = 1.4426950408889634


@ti.func
def fast_exp2(x, real: ti.template()):
    """2^x for x <= 0. In float32 with a relative error below 4e-7, and about 2e-38 below -125; in float64 by pow.

    The result is 2^n, by its exponent bits, times a minimax polynomial of 2^f, where n is the truncation of x and f is
    in (-1, 0]. Truncation converts to an integer and back, since Taichi's fast-math would cancel the trick of rounding
    by adding a large number. `select` replaces `max`, which would handle NaN.
    """
    result = ti.cast(0.0, real)
    if ti.static(real == ti.f32):
        t = ti.select(x > -125.0, x, -125.0)
        n = ti.cast(t, ti.i32)
        f = t - ti.cast(n, ti.f32)
        p = 0.99999994 + f * (0.69314224 + f * (0.2401722 + f * (0.055279724 + f * (0.009188612 + f * 0.00093878835))))
        result = ti.bit_cast(ti.bit_cast(p, ti.i32) + (n << 23), ti.f32)
    else:
        result = ti.pow(ti.cast(2.0, real), x)
    return result
