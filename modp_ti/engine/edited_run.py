"""`clean_run`, `crop_run` and `scale_run`: a new output folder with a part of a finished map, or in other units."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from fields.frames.origin import shifted_poses
from fields.geometry.se3 import camera_centres
from fields.runtime.backend import initialise
from modp_ti.config.scene_file import dump_scene
from modp_ti.engine.cleaned import cleaned, thinned
from modp_ti.engine.refined_run import mapper_of, refinable
from modp_ti.engine.results import OUTDATED
from modp_ti.files import read_json
from modp_ti.files.atomic import replace_text
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing, is_run_folder
from modp_ti.outputs.formats.splats_ply import check_splats, write_splats
from modp_ti.outputs.formats.trajectory import write_trajectory
from modp_ti.outputs.measuring import WORLD, read_world
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run
from modp_ti.outputs.playback.run_frames import frames_of, run_settings
from modp_ti.outputs.progress import ProgressLine
from modp_ti.outputs.splat_page.page import levelled, moved

# What the new folder takes over as it is. Scores, pictures and report are of the whole map.
COPIED = ("trajectory.txt", "frames.json", "exposure.json", "scores.csv", "recording.yaml", "colmap", "masks", WORLD)
# Entries of metrics.json that mark folders of this file, which another call may replace.
EDITS = ("cleaned", "cropped", "scaled")
# Entries of world.json that hold for one position and direction of the world only.
ON_EARTH = ("axes", "origin", "origin_deviation", "heading_deviation")


@dataclass(frozen=True)
class Region:
    """A part of space in the world of trajectory.txt. All that is given must hold for the centre of a Gaussian.

    Attributes:
        box: Two opposite corners (6,).
        sphere: Centre and radius (4,).
        around_cameras: Largest distance from the nearest camera.
        above: Least height over the middle of the cameras.
    """

    box: Sequence[float] | None = None
    sphere: Sequence[float] | None = None
    around_cameras: float | None = None
    above: float | None = None

    def contains(
        self, xyz: NDArray[np.float64], centres: NDArray[np.float64], down: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return whether points (N, 3) lie in the region, given the cameras' centres (F, 3) and down (3,)."""
        inside = np.ones(len(xyz), dtype=bool)
        if self.box is not None:
            low, high = np.sort(np.reshape(self.box, (2, 3)), axis=0)
            inside &= ((xyz >= low) & (xyz <= high)).all(axis=1)
        if self.sphere is not None:
            inside &= np.linalg.norm(xyz - self.sphere[:3], axis=1) <= self.sphere[3]
        if self.around_cameras is not None:
            near = np.full(len(xyz), np.inf)
            for centre in centres:
                np.minimum(near, np.linalg.norm(xyz - centre, axis=1), out=near)
            inside &= near <= self.around_cameras
        if self.above is not None:
            inside &= (np.median(centres, axis=0) - xyz) @ down >= self.above
        return inside


def crop_run(folder: Path, output: Path, region: Region) -> dict[str, Any]:
    """Write a new output folder with the Gaussians of a finished run that lie in a region.

    Args:
        folder: Output folder of the run.
        output: The new folder.
        region: What stays.

    Returns:
        `kept` and `removed`: numbers of Gaussians.

    Raises:
        InputError: If there is no finished run, nothing is left, or the folder cannot be written.
    """
    run = open_run(folder)
    origin = run.record.origin
    centres = camera_centres(run.poses) + origin
    kept = region.contains(run.gaussians["position"].astype(np.float64) + origin, centres, levelled(run).R[1])
    entry = {"kept": int(kept.sum()), "removed": int((~kept).sum())}
    with _written(run, _those(run, kept), output, {"cropped": entry}):
        pass
    return entry


def clean_run(folder: Path, output: Path, console: Console | None = None) -> dict[str, Any]:
    """Write a new output folder with the map of a finished run without its faults, see `cleaned`.

    Args:
        folder: Output folder of the run.
        output: The new folder.
        console: Receives progress, None for no output.

    Returns:
        What was removed, see `cleaned`.

    Raises:
        InputError: If there is no finished run, its frames cannot be read again, or the folder cannot be written.
    """
    run = open_run(folder)
    config, line = refinable(run), ProgressLine(console or Console(quiet=True))
    try:
        initialise(config.device, config.mapper_threads, config.seed)
    except RuntimeError as error:
        raise InputError(str(error)) from None
    mapper = mapper_of(run, config, line)
    frames = frames_of(run, thinned(run.record.held_out), line.prepare)
    held_out = [(frame, frame.T_camera_world) for frame in frames]
    with line.working("looking for faults"):
        kept, entry = cleaned(mapper, held_out)
    with _written(run, _those(run, kept), output, {"cleaned": entry}):
        pass
    return entry


def scale_run(
    folder: Path,
    output: Path,
    s: float,
    R: NDArray[np.float64],
    about: dict[str, Any],
    t: NDArray[np.float64],
) -> None:
    """Write a new output folder with the map of a finished run moved to a point's place s R x + t.

    Splats, poses, points and all lengths are changed; what is relative to them, such as scores, stays.

    Args:
        folder: Output folder of the run.
        output: The new folder.
        s: Factor on lengths.
        R: Rotation (3, 3).
        about: What `world.json` says of the new units and axes.
        t: Translation (3,).

    Raises:
        InputError: If there is no finished run, or the folder cannot be written.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    run = open_run(folder)
    origin = s * R @ run.record.origin + t
    poses = run.poses.copy()
    poses[:, :3, :3], poses[:, :3, 3] = poses[:, :3, :3] @ R.T, s * poses[:, :3, 3]
    gaussians = {name: values.astype(np.float32) for name, values in moved(run.gaussians, R, s).items()}
    # What places the world on the Earth is of the world before, unless it is given again.
    world = {name: value for name, value in read_world(run.folder).items() if name not in ON_EARTH} | about
    record = read_json(run.folder / "frames.json", "of a finished run")
    record |= {"near": s * record["near"], "scene_depth": s * record["scene_depth"], "origin": origin.tolist()}
    with _written(run, gaussians, output, {"scaled": {"factor": s, **world}}, origin) as new:
        write_trajectory(new / "trajectory.txt", run.timestamps, list(shifted_poses(poses, origin)))
        model = pycolmap.Reconstruction(str(new / "colmap"))
        model.transform(pycolmap.Sim3d(np.column_stack([s * R, t])))
        model.write_binary(str(new / "colmap"))
        replace_text(new / "frames.json", json.dumps(record, indent=1) + "\n")
        replace_text(new / WORLD, json.dumps(world, indent=2) + "\n")


def _those(run: FinishedRun, kept: NDArray[np.bool_]) -> dict[str, NDArray[np.float32]]:
    """Return the Gaussians that are kept (N,). Raises InputError if there are none."""
    if not kept.any():
        raise InputError(f"{run.folder}: none of its {len(kept)} Gaussians would be left")
    return {name: values[kept] for name, values in run.gaussians.items()}


@contextmanager
def _written(
    run: FinishedRun,
    gaussians: dict[str, NDArray[np.float32]],
    output: Path,
    entry: dict[str, Any],
    origin: NDArray[np.float64] | None = None,
) -> Iterator[Path]:
    """Write a folder as the run's with other Gaussians, and an entry of what was done in metrics.json.

    The caller may change the files of the folder that is handed out, before it appears.

    Raises:
        InputError: If the folder cannot be written.
    """
    output, origin = output.expanduser().absolute(), run.record.origin if origin is None else origin
    metrics = read_json(run.folder / "metrics.json", "of a finished run")
    if is_run_folder(output):
        there = read_json(output / "metrics.json", "of a finished run")
        if output.resolve() == run.folder.resolve() or not {*EDITS} & there.keys():
            raise InputError(f"{output}: holds the map of a run, which stays as it is: name another folder (-o)")
    config = run_settings(run).model_copy(update={"output": output})
    with appearing(output, OUTDATED) as folder:
        for name in COPIED:
            source = run.folder / name
            if source.is_dir():
                shutil.copytree(source, folder / name)
            elif source.is_file():
                shutil.copy(source, folder / name)
        write_splats(folder / "splats.ply", gaussians, origin)
        check_splats(folder / "splats.ply", gaussians, origin)
        dump_scene(config, folder / "config.yaml")
        metrics |= {"gaussians": len(gaussians["position"]), **entry}
        replace_text(folder / "metrics.json", json.dumps(metrics, indent=2) + "\n")
        yield folder
