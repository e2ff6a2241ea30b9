"""Kernels that copy the values of Gaussians between Taichi fields and arrays."""
# pyright: reportInvalidTypeForm=false

from fields.runtime.engine import ti


@ti.kernel
def read_values(
    position: ti.template(),
    log_scale: ti.template(),
    quaternion: ti.template(),
    opacity_logit: ti.template(),
    sh: ti.template(),
    first: ti.i32,
    to_position: ti.types.ndarray(),
    to_log_scale: ti.types.ndarray(),
    to_quaternion: ti.types.ndarray(),
    to_opacity_logit: ti.types.ndarray(),
    to_sh: ti.types.ndarray(),
):
    """Copy N Gaussians from `first` on, from fields to arrays of the shapes of `GaussianField.append`."""
    for i in range(to_opacity_logit.shape[0]):
        for c in ti.static(range(3)):
            to_position[i, c] = position[first + i][c]
            to_log_scale[i, c] = log_scale[first + i][c]
        for c in ti.static(range(4)):
            to_quaternion[i, c] = quaternion[first + i][c]
        to_opacity_logit[i] = opacity_logit[first + i]
        for k in range(to_sh.shape[1]):
            for c in ti.static(range(3)):
                to_sh[i, k, c] = sh[first + i, k][c]


@ti.kernel
def write_values(
    position: ti.template(),
    log_scale: ti.template(),
    quaternion: ti.template(),
    opacity_logit: ti.template(),
    sh: ti.template(),
    first: ti.i32,
    of_position: ti.types.ndarray(),
    of_log_scale: ti.types.ndarray(),
    of_quaternion: ti.types.ndarray(),
    of_opacity_logit: ti.types.ndarray(),
    of_sh: ti.types.ndarray(),
):
    """Copy arrays of the shapes of `GaussianField.append` to N Gaussians of fields, from `first` on."""
    for i in range(of_opacity_logit.shape[0]):
        for c in ti.static(range(3)):
            position[first + i][c] = of_position[i, c]
            log_scale[first + i][c] = of_log_scale[i, c]
        for c in ti.static(range(4)):
            quaternion[first + i][c] = of_quaternion[i, c]
        opacity_logit[first + i] = of_opacity_logit[i]
        for k in range(of_sh.shape[1]):
            for c in ti.static(range(3)):
                sh[first + i, k][c] = of_sh[i, k, c]


@ti.kernel
def read_numbers(field: ti.template(), first: ti.i32, out: ti.types.ndarray(ndim=1)):
    """Copy N entries of a field, from `first` on."""
    for i in range(out.shape[0]):
        out[i] = field[first + i]


@ti.kernel
def write_integers(field: ti.template(), first: ti.i32, values: ti.types.ndarray(dtype=ti.i32, ndim=1)):
    """Replace N entries of a field, from `first` on."""
    for i in range(values.shape[0]):
        field[first + i] = values[i]


@ti.kernel
def write_reals(field: ti.template(), first: ti.i32, values: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    """Replace N entries of a field, from `first` on."""
    for i in range(values.shape[0]):
        field[first + i] = values[i]
