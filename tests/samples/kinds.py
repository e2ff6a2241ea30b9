"""A small valid recording of every kind of input: what the contract of readers, damage and fuzzing begin with."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from PIL import Image

from tests.samples import trackers
from tests.samples.bags import write_small_bag
from tests.samples.captures import WRITERS, zipped
from tests.samples.filmed import Filmed, film, write_image, write_scene, write_text

FRAMES, SIZE = 3, (48, 36)
SMALL = film(FRAMES, SIZE)

CHECK = ("check", "scene.yaml", "--quiet")
EXPORT = ("export", "out", "--format", "points", "-o", "written.ply", "--quiet")
MODEL = ("cameras", "images", "points3D")
BAGS = {"ros1": "room.bag", "sqlite3": "room.db3", "mcap": "room.mcap"}
IMAGES = ["0.png", "1.jpg", "2.bmp", "3.tiff", "4.webp", "5.ppm", "6.avif"]
if find_spec("pillow_heif") is not None:
    IMAGES.append("7.heic")


@dataclass(frozen=True)
class Sample:
    """A kind of input.

    Attributes:
        write: Writes the folder of a scene.
        files: The files whose damage is tested, relative to the folder.
        arguments: Arguments of `modp-ti`, which runs in the folder.
        is_tracker: Whether it is read by a reader of poses, which the contract is for.
    """

    write: Callable[[Path, Filmed], None]
    files: tuple[str, ...]
    arguments: tuple[str, ...] = CHECK
    is_tracker: bool = True


def _write_scene(folder: Path, filmed: Filmed) -> None:
    trackers.write_colmap_text(folder, filmed)
    lines = ["source:", "  path: images", "  scale: 1.0", "tracker:", "  kind: colmap", "output: out", "device: cpu"]
    write_text(folder / "scene.yaml", lines)


def _write_formats(folder: Path, filmed: Filmed) -> None:
    """A file of each format of images."""
    views = [filmed.views[i % FRAMES] for i in range(len(IMAGES))]
    several = Filmed(views, filmed.points, IMAGES)
    for view, name in zip(views, IMAGES, strict=True):
        file = folder / "images" / name
        if file.suffix == ".avif":
            Image.fromarray(view.image[..., ::-1]).save(file, "AVIF")
        elif file.suffix == ".heic":
            import pillow_heif

            with io.BytesIO() as stream:
                pillow_heif.from_pillow(Image.fromarray(view.image[..., ::-1])).save(stream)
                file.write_bytes(stream.getvalue())
        else:
            write_image(file, view.image)
    trackers.colmap_text(folder, several)
    write_scene(folder, "kind: colmap", "path: images")


def _write_masks(folder: Path, filmed: Filmed) -> None:
    trackers.write_colmap_text(folder, filmed)
    for name in filmed.names:
        write_image(folder / "masks" / name, np.full(SIZE[::-1], 255, np.uint8))
    write_image(folder / "vignette.png", np.full(SIZE[::-1], 60000, np.uint16))
    write_scene(folder, "kind: colmap", "path: images, masks: masks, vignette: vignette.png")


def splats(filmed: Filmed) -> bytes:
    """Return a map of a Gaussian at each point as a 3DGS PLY."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    table = np.zeros((len(filmed.points), len(names)), "<f4")
    table[:, :3], table[:, 10:13], table[:, 13] = filmed.points, -3.0, 1.0
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [*(f"property float {name}" for name in names), "end_header"]
    return ("\n".join(header) + "\n").encode() + table.tobytes()


def _write_run(folder: Path, filmed: Filmed) -> None:
    """The output folder of a finished run, `out`."""
    trackers.write_colmap(folder, filmed)
    trackers.colmap_binary(folder / "out/colmap", filmed)
    (folder / "out/splats.ply").write_bytes(splats(filmed))
    write_text(folder / "out/trajectory.txt", filmed.tum_lines())
    record = {"near": 0.1, "scene_depth": 3.0, "keyframes": [0, 2], "held_out": [1]}
    write_text(folder / "out/frames.json", [json.dumps(record)])
    matrix = np.eye(3, 4).tolist()
    frames = [{"index": i, "timestamp": i / 30, "keyframe": True, "matrix": matrix} for i in range(FRAMES)]
    write_text(folder / "out/exposure.json", [json.dumps({"frames": frames})])
    write_image(folder / "out/masks/000000.png", np.full((SIZE[1] // 2, SIZE[0] // 2), 255, np.uint8))
    scores = [f"{i},{name},0,online,30.5,0.9,,0.8" for i, name in enumerate(filmed.names)]
    write_text(folder / "out/scores.csv", ["index,name,held_out,stage,psnr,ssim,lpips,detail", *scores])
    shutil.copy(folder / "scene.yaml", folder / "out/config.yaml")


def _write_capture(kind: str, place: str, folder: Path, filmed: Filmed) -> None:
    """A capture at this place, packed if that has a suffix."""
    WRITERS[kind](folder / "unpacked", filmed.views)
    if Path(place).suffix:
        zipped(folder / "unpacked", folder / place)
        shutil.rmtree(folder / "unpacked")
    else:
        (folder / "unpacked").rename(folder / place)
    write_scene(folder, f"kind: {kind}", f"path: {place}")


def _write_bag(form: str, depths: bool, folder: Path, filmed: Filmed) -> None:
    write_small_bag(folder / BAGS[form], form, filmed, depths)
    write_scene(folder, f"kind: bag, {'depth: /depth' if depths else 'points: /map'}", f"path: {BAGS[form]}")


def _capture(kind: str, place: str, *files: str) -> Sample:
    return Sample(partial(_write_capture, kind, place), tuple(f"{place}/{file}" for file in files) or (place,))


MPS = (
    "closed_loop_trajectory.csv",
    "online_calibration.jsonl",
    "semidense_points.csv.gz",
    "semidense_observations.csv",
)
SAMPLES = {
    "scene": Sample(_write_scene, ("scene.yaml",), is_tracker=False),
    "image": Sample(_write_formats, tuple(f"images/{name}" for name in IMAGES), is_tracker=False),
    "mask": Sample(_write_masks, (f"masks/{SMALL.names[1]}", "vignette.png"), is_tracker=False),
    "run": Sample(
        _write_run,
        ("out/splats.ply", "out/trajectory.txt", "out/frames.json", *(f"out/colmap/{stem}.bin" for stem in MODEL)),
        EXPORT,
        is_tracker=False,
    ),
    "colmap_text": Sample(trackers.write_colmap_text, tuple(f"sparse/0/{stem}.txt" for stem in MODEL)),
    "colmap": Sample(trackers.write_colmap, tuple(f"sparse/0/{stem}.bin" for stem in MODEL)),
    "transforms": Sample(trackers.write_transforms, ("transforms.json",)),
    "tum": Sample(trackers.write_tum, ("trajectory.txt", "points.txt")),
    "ply": Sample(trackers.write_ply, ("points.ply",)),
    "video": Sample(trackers.write_video, ("room.mp4",)),
    "orbslam3": Sample(trackers.write_orbslam3, ("CameraTrajectory.txt",)),
    "tum_rgbd": Sample(trackers.write_tum_rgbd, ("rgb.txt",)),
    "replica": Sample(trackers.write_replica, ("traj.txt",)),
    "replica_depth": Sample(trackers.write_replica_depth, ("depth/depth000001.png",)),
    "matrices": Sample(trackers.write_matrices, ("poses.txt",)),
    "tanksandtemples": Sample(trackers.write_log, ("scene.log",)),
    "sevenscenes": Sample(trackers.write_sevenscenes, ("seq/frame-000001.pose.txt",)),
    "modp": Sample(
        trackers.write_modp,
        ("trajectory.json", "point_cloud/point_cloud_1.txt", "point_cloud/point_cloud_2.npy"),
    ),
    "aria": Sample(trackers.write_aria, MPS),
    "stella_vslam": Sample(trackers.write_stella, ("map.msg",)),
    "record3d": _capture("record3d", "room.r3d"),
    "scanner_app": _capture("scanner_app", "app", "frame_00003.json", "depth_00003.png"),
    "stray_scanner": _capture("stray_scanner", "room", "odometry.csv"),
    "polycam": _capture("polycam", "room", "keyframes/cameras/1733333.json"),
    "nerfcapture": _capture("nerfcapture", "room", "transforms.json"),
    "euroc": _capture(
        "euroc", "room", "mav0/cam0/sensor.yaml", "mav0/state_groundtruth_estimate0/data.csv", "mav0/cam0/data.csv"
    ),
    "kitti": _capture("kitti", "room", "poses.txt", "calib.txt", "times.txt"),
    "scannet": _capture(
        "scannet",
        "room",
        "pose/1.txt",
        *(f"intrinsic/intrinsic_{name}.txt" for name in ("color", "depth")),
        "depth/1.png",
    ),
    "arkitscenes": _capture("arkitscenes", "room", "lowres_wide.traj", "lowres_wide_intrinsics/42_3000.101.pincam"),
    **{f"bag_{form}": Sample(partial(_write_bag, form, False), (file,)) for form, file in BAGS.items()},
    "bag_depth": Sample(partial(_write_bag, "mcap", True), (BAGS["mcap"],)),
}
"""The kinds of input by name, several of some trackers."""


def write_sample(kind: str, folder: Path, filmed: Filmed = SMALL) -> Sample:
    """Write a kind of input to a new folder."""
    folder.mkdir(parents=True)
    SAMPLES[kind].write(folder, filmed)
    return SAMPLES[kind]
