"""Bundle adjustment of poses and points with pycolmap and Ceres."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.processes import child_environment

if TYPE_CHECKING:
    from modp_ti.files.quiet_pycolmap import pycolmap

TOLERANCE = 1e-5  # relative change of the cost below which the optimisation stops

Refinable = Literal["focal", "distortion"]
CODE = "from modp_ti.inputs.multiview.bundle_adjustment import main; main()"


@dataclass(frozen=True)
class Bundle:
    """Result of a bundle adjustment.

    Attributes:
        poses: T_camera_world (4, 4) of the free views, by view.
        points: (P,) indices of the observed points.
        xyz: (P, 3) their positions.
        camera: The camera, refined if requested.
        cost: Mean cost per observation [px^2 / 2].
    """

    poses: dict[int, NDArray[np.float64]]
    points: NDArray[np.int64]
    xyz: NDArray[np.float64]
    camera: pycolmap.Camera
    cost: float


def adjusted_bundle(
    camera: pycolmap.Camera,
    poses: Mapping[int, NDArray[np.float64]],
    view: NDArray[np.int64],
    point: NDArray[np.int64],
    pixels: NDArray[np.float64],
    xyz: NDArray[np.float64],
    free: Collection[int],
    steps: int,
    loss_width: float = 1.0,
    refined: Collection[Refinable] = (),
    held: Collection[int] = (),
) -> Bundle | None:
    """Minimise the reprojection error under a Cauchy loss over poses and points.

    Args:
        camera: Camera of all views, with camera_id 1.
        poses: T_camera_world (4, 4) by view. Views that are not free are fixed. If all are free, the first two fix the
            gauge.
        view: (M,) view of each observation.
        point: (M,) point of each observation.
        pixels: (M, 2) pixel of each observation.
        xyz: (C, 3) initial positions of the points.
        free: Views whose poses are optimised.
        steps: Levenberg-Marquardt steps at most.
        loss_width: Scale of the Cauchy loss [px].
        refined: Parts of the camera that are optimised too.
        held: Points that stay where they are.

    Returns:
        The optimised poses, camera and points, without those that only one view observes; None if Ceres finds no usable
        solution.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    model, config = pycolmap.Reconstruction(), pycolmap.BundleAdjustmentConfig()
    model.add_camera_with_trivial_rig(camera)
    tracks = _add_views(model, config, poses, view, point, pixels, free)
    # One ray constrains nothing, and COLMAP refuses it.
    names = {number: model.add_point3D(xyz[number], track) for number, track in tracks if track.length() > 1}
    for number in held:
        if number in names:
            config.add_constant_point(names[number])
    if len(free) == len(poses):
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    if not refined:
        config.set_constant_cam_intrinsics(1)

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length, options.refine_extra_params = "focal" in refined, "distortion" in refined
    options.refine_principal_point = options.refine_sensor_from_rig = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_width
    solver = options.ceres.solver_options
    solver.max_num_iterations = steps
    solver.num_threads = 1  # with several threads, the order of summation and so the result would vary between runs
    solver.function_tolerance = TOLERANCE
    summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    if not summary.is_solution_usable():
        return None
    numbers = np.fromiter(names, np.int64, len(names))
    places = np.array([model.point3D(name).xyz for name in names.values()]).reshape(-1, 3)
    finite = np.isfinite(places).all(axis=1)
    # The declared type is the base class, which has no Ceres summary.
    solved = isinstance(summary, pycolmap.CeresBundleAdjustmentSummary)
    cost = summary.ceres_summary.final_cost / len(view) if solved else 0.0
    found = {k: np.vstack([model.image(k + 1).cam_from_world().matrix(), (0.0, 0.0, 0.0, 1.0)]) for k in free}
    found = {k: T for k, T in found.items() if np.isfinite(T).all()}
    return Bundle(found, numbers[finite], places[finite], model.camera(1), float(cost))


def _add_views(
    model: pycolmap.Reconstruction,
    config: pycolmap.BundleAdjustmentConfig,
    poses: Mapping[int, NDArray[np.float64]],
    view: NDArray[np.int64],
    point: NDArray[np.int64],
    pixels: NDArray[np.float64],
    free: Collection[int],
) -> Iterator[tuple[int, pycolmap.Track]]:
    """Add the views with their observations, view k as image k + 1.

    Yields every observed point, in the order of their first observations, with its track.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    mine = {k: np.flatnonzero(view == k) for k in poses}
    for k, T in poses.items():
        image = pycolmap.Image(name=str(k), keypoints=pixels[mine[k]], camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(T[:3]))
        config.add_image(k + 1)
        if k not in free:
            config.set_constant_rig_from_world_pose(k + 1)
    images = np.repeat([k + 1 for k in mine], [len(rows) for rows in mine.values()])
    places = np.concatenate([np.arange(len(rows)) for rows in mine.values()])
    numbers = point[np.concatenate(list(mine.values()))]
    first, of, counts = np.unique(numbers, return_index=True, return_inverse=True, return_counts=True)[1:]
    by_point = np.argsort(first[of], kind="stable")
    elements = list(map(pycolmap.TrackElement, images[by_point].tolist(), places[by_point].tolist()))
    ends = np.cumsum(counts[np.argsort(first)]).tolist()
    starts = [0, *ends[:-1]]
    for number, start, end in zip(numbers[np.sort(first)].tolist(), starts, ends, strict=True):
        yield number, pycolmap.Track(elements[start:end])


def adjusted_apart(*arguments: object, **keywords: object) -> Bundle | None:
    """Call `adjusted_bundle` with these arguments in a process of its own.

    Returns:
        The same result; None also if the process fails, for example because memory is short.
    """
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        input=pickle.dumps((arguments, keywords)),
        stdout=subprocess.PIPE,
        env=child_environment(),
        start_new_session=True,  # Ctrl-C is for this process
        check=False,
    )
    return None if done.returncode else pickle.loads(done.stdout)


def main() -> None:
    """Serve one call, which comes through the standard input."""
    arguments, keywords = pickle.load(sys.stdin.buffer)
    sys.stdout.buffer.write(pickle.dumps(adjusted_bundle(*arguments, **keywords)))
