"""`clean_run` and `crop_run`: a new output folder with some of the Gaussians of a finished run."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from fields.geometry.se3 import camera_centres
from fields.runtime.backend import initialise
from modp_ti.config.scene_file import dump_scene
from modp_ti.engine.refined_run import mapper_of, refinable
from modp_ti.engine.results import OUTDATED
from modp_ti.files import read_json
from modp_ti.files.atomic import replace_text
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing, is_run_folder
from modp_ti.outputs.evaluation import keyframe_psnr, score_frame
from modp_ti.outputs.formats.splats_ply import check_splats, write_splats
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run
from modp_ti.outputs.playback.run_frames import frames_of, run_settings
from modp_ti.outputs.progress import ProgressLine
from pipelines.whole.cleaning import faults, harmless

# What the new folder takes over as it is. Scores, pictures and report are of the whole map.
COPIED = ("trajectory.txt", "frames.json", "exposure.json", "scores.csv", "recording.yaml", "colmap", "masks")
# Loss of held-out quality that removing faults may cost [dB].
LOSS = 0.05
# Frames that it is measured on, evenly spaced.
MEASURED = 32


@dataclass(frozen=True)
class Region:
    """A part of space in the world of trajectory.txt. All that is given must hold for the centre of a Gaussian.

    Attributes:
        box: Two opposite corners (6,).
        sphere: Centre and radius (4,).
        around_cameras: Largest distance from the nearest camera.
        above: Least height over the middle of the cameras, along their mean up.
    """

    box: Sequence[float] | None = None
    sphere: Sequence[float] | None = None
    around_cameras: float | None = None
    above: float | None = None

    def contains(self, xyz: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether points (N, 3) lie in the region, given all T_camera_world (F, 4, 4)."""
        inside = np.ones(len(xyz), dtype=bool)
        centres = camera_centres(poses)
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
            up = -poses[:, 1, :3].mean(axis=0)
            inside &= (xyz - np.median(centres, axis=0)) @ (up / np.linalg.norm(up)) >= self.above
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
    poses = run.poses.copy()
    poses[:, :3, 3] -= poses[:, :3, :3] @ origin
    kept = region.contains(run.gaussians["position"].astype(np.float64) + origin, poses)
    entry = {"kept": int(kept.sum()), "removed": int((~kept).sum())}
    _write(run, kept, output, {"cropped": entry})
    return entry


def clean_run(folder: Path, output: Path, console: Console | None = None) -> dict[str, Any]:
    """Write a new output folder with the map of a finished run without its faults, see `pipelines.whole.cleaning`.

    What would cost more than `LOSS` on held-out frames (on keyframes, if none were held out) stays.

    Args:
        folder: Output folder of the run.
        output: The new folder.
        console: Receives progress, None for no output.

    Returns:
        `removed`: numbers of Gaussians by kind, `kept`, and the PSNR `before` and `after` [dB].

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
    held_out = run.record.held_out[:: -(-len(run.record.held_out) // MEASURED) or 1]
    frames = list(frames_of(run, held_out, line.prepare))
    views = list(mapper.keyframes)[:: -(-len(mapper.keyframes) // MEASURED)]
    exposures = [mapper.keyframes.exposure_at(frame.index) for frame in frames]

    def score(kept: NDArray[np.bool_]) -> float:
        mapper.gaussians.load({name: values[kept] for name, values in run.gaussians.items()})
        scores = [
            score_frame(mapper, frame, frame.T_camera_world, "", None, exposure)[0].psnr
            for frame, exposure in zip(frames, exposures, strict=True)
        ]
        return float(np.mean(scores or [keyframe_psnr(mapper, view) for view in views]))

    with line.working("looking for faults"):
        taken, before, after = harmless(*faults(mapper), score, LOSS)
    kept = ~np.any(list(taken.values()), axis=0)
    entry = {
        "removed": {kind: int(mask.sum()) for kind, mask in taken.items()},
        "kept": int(kept.sum()),
        "held_out": bool(frames),
        "before": round(before, 4),
        "after": round(after, 4),
    }
    _write(run, kept, output, {"cleaned": entry})
    return entry


def _write(run: FinishedRun, kept: NDArray[np.bool_], output: Path, entry: dict[str, Any]) -> None:
    """Write a folder as the run's with the Gaussians that are kept (N,), and an entry of what was done in metrics.json.

    Raises:
        InputError: If nothing is kept, or the folder cannot be written.
    """
    output = output.expanduser().absolute()
    if not kept.any():
        raise InputError(f"{run.folder}: none of its {len(kept)} Gaussians would be left")
    metrics = read_json(run.folder / "metrics.json", "of a finished run")
    if is_run_folder(output):
        there = read_json(output / "metrics.json", "of a finished run")
        if output.resolve() == run.folder.resolve() or not {"cleaned", "cropped"} & there.keys():
            raise InputError(f"{output}: holds the map of a run, which stays as it is: name another folder (-o)")
    gaussians = {name: values[kept] for name, values in run.gaussians.items()}
    config = run_settings(run).model_copy(update={"output": output})
    with appearing(output, OUTDATED) as folder:
        for name in COPIED:
            source = run.folder / name
            if source.is_dir():
                shutil.copytree(source, folder / name)
            elif source.is_file():
                shutil.copy(source, folder / name)
        write_splats(folder / "splats.ply", gaussians, run.record.origin)
        check_splats(folder / "splats.ply", gaussians, run.record.origin)
        dump_scene(config, folder / "config.yaml")
        metrics |= {"gaussians": int(kept.sum()), **entry}
        replace_text(folder / "metrics.json", json.dumps(metrics, indent=2) + "\n")
