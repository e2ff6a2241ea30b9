"""Kernels that copy the values of Gaussians between Taichi fields and arrays."""
# pyright: reportInvalidTypeForm=false

from fields.runtime.engine import ti

__all__ = ["read_numbers", "read_values", "write_integers", "write_values"]


@ti.kernel
def read_values(
    position: ti.template(),
    log_scale: ti.template(),
    quaternion: ti.template(),
    opacity_logit: ti.template(),
    sh: ti.template(),
    to_position: ti.types.ndarray(),
    to_log_scale: ti.types.ndarray(),
    to_quaternion: ti.types.ndarray(),
    to_opacity_logit: ti.types.ndarray(),
    to_sh: ti.types.ndarray(),
):
    """Copy the first N Gaussians from fields to arrays of the shapes of `GaussianField.append`."""
    for i in range(to_opacity_logit.shape[0]):
        for c in ti.static(range(3)):
            to_position[i, c] = position[i][c]
            to_log_scale[i, c] = log_scale[i][c]
        for c in ti.static(range(4)):
            to_quaternion[i, c] = quaternion[i][c]
        to_opacity_logit[i] = opacity_logit[i]
        for k in range(to_sh.shape[1]):
            for c in ti.static(range(3)):
                to_sh[i, k, c] = sh[i, k][c]


@ti.kernel
def write_values(
    position: ti.template(),
    log_scale: ti.template(),
    quaternion: ti.template(),
    opacity_logit: ti.template(),
    sh: ti.template(),
    of_position: ti.types.ndarray(),
    of_log_scale: ti.types.ndarray(),
    of_quaternion: ti.types.ndarray(),
    of_opacity_logit: ti.types.ndarray(),
    of_sh: ti.types.ndarray(),
):
    """Copy arrays of the shapes of `GaussianField.append` to the first N Gaussians of fields."""
    for i in range(of_opacity_logit.shape[0]):
        for c in ti.static(range(3)):
            position[i][c] = of_position[i, c]
            log_scale[i][c] = of_log_scale[i, c]
        for c in ti.static(range(4)):
            quaternion[i][c] = of_quaternion[i, c]
        opacity_logit[i] = of_opacity_logit[i]
        for k in range(of_sh.shape[1]):
            for c in ti.static(range(3)):
                sh[i, k][c] = of_sh[i, k, c]


@ti.kernel
def read_numbers(field: ti.template(), out: ti.types.ndarray(ndim=1)):
    """Copy the first N entries of a field."""
    for i in range(out.shape[0]):
        out[i] = field[i]


@ti.kernel
def write_integers(field: ti.template(), values: ti.types.ndarray(dtype=ti.i32, ndim=1)):
    """Replace the first N entries of a field."""
    for i in range(values.shape[0]):
        field[i] = values[i]
