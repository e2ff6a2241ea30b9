"""Small valid inputs of every reader, from which the malformed inputs are made."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np

from tests.bags import FORMS
from tests.captures import WRITERS, View, zipped
from tests.fault_injection.small_bag import BAGS, write_small_bag
from tests.fault_injection.small_recording import (
    FOCAL,
    FRAMES,
    HEIGHT,
    INTRINSICS,
    NAMES,
    WIDTH,
    picture,
    points_file,
    position,
    scene_file,
    tum_line,
    wall,
    write_bytes,
    write_images,
    write_text,
)
from tests.fault_injection.tracker_samples import (
    colmap_binary,
    colmap_text,
    write_aria,
    write_colmap_binary,
    write_colmap_text,
    write_log,
    write_matrices,
    write_modp,
    write_orbslam3,
    write_points_ply,
    write_replica,
    write_scene,
    write_sevenscenes,
    write_stella,
    write_transforms,
    write_tum,
    write_tum_rgbd,
)


@dataclass(frozen=True)
class Sample:
    """The input of a reader.

    Attributes:
        files: The files under test, relative to the folder.
        arguments: Arguments of `modp-ti`, which runs in the folder.
    """

    reader: str
    files: tuple[str, ...]
    arguments: tuple[str, ...] = ("check", "scene.yaml", "--quiet")


IMAGES = ["0.png", "1.jpg", "2.bmp", "3.tiff", "4.webp", "5.ppm", "6.avif"]
if find_spec("pillow_heif") is not None:
    IMAGES.append("7.heic")


def _write_image(folder: Path) -> None:
    write_images(folder, IMAGES)
    colmap_text(folder, IMAGES)
    scene_file(folder, "kind: colmap", "path: images")


def _write_mask(folder: Path) -> None:
    write_images(folder)
    colmap_text(folder)
    for name in NAMES:
        write_bytes(folder, f"masks/{name}", cv2.imencode(".png", np.full((HEIGHT, WIDTH), 255, np.uint8))[1].tobytes())
    light = np.full((HEIGHT, WIDTH), 60000, np.uint16)
    write_bytes(folder, "vignette.png", cv2.imencode(".png", light)[1].tobytes())
    scene_file(folder, "kind: colmap", "path: images, masks: masks, vignette: vignette.png")


def _write_video(folder: Path) -> None:
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read once, at the first use in the process
    writer = cv2.VideoWriter(str(folder / "room.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30.0, (WIDTH, HEIGHT))
    for i in range(FRAMES):
        writer.write(picture(i))
    writer.release()
    write_text(folder, "trajectory.txt", [tum_line(i) for i in range(FRAMES)])
    points_file(folder)
    scene_file(folder, "kind: tum, points: points.txt", f"path: room.mp4, {INTRINSICS}")


def splats() -> bytes:
    """Return a map of 40 Gaussians as a 3DGS PLY."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    table = np.zeros((40, len(names)), "<f4")
    table[:, :3] = wall()
    table[:, 10:13] = -3.0
    table[:, 13] = 1.0
    header = ["ply", "format binary_little_endian 1.0", "element vertex 40", *(f"property float {n}" for n in names)]
    return ("\n".join([*header, "end_header"]) + "\n").encode() + table.tobytes()


def _write_run(folder: Path) -> None:
    """Write the output folder of a finished run, `out`."""
    write_colmap_binary(folder)
    colmap_binary(folder, inside="out/colmap")
    write_bytes(folder, "out/splats.ply", splats())
    write_text(folder, "out/trajectory.txt", [tum_line(i) for i in range(FRAMES)])
    write_text(folder, "path.txt", [tum_line(i) for i in range(FRAMES)])
    record = {"near": 0.1, "scene_depth": 3.0, "keyframes": [0, 2], "held_out": [1]}
    write_text(folder, "out/frames.json", [json.dumps(record)])
    matrix = np.eye(3, 4).tolist()
    frames = [{"index": i, "timestamp": i / 30, "keyframe": True, "matrix": matrix} for i in range(FRAMES)]
    write_text(folder, "out/exposure.json", [json.dumps({"frames": frames})])
    mask = np.full((HEIGHT // 2, WIDTH // 2), 255, np.uint8)
    write_bytes(folder, "out/masks/000000.png", cv2.imencode(".png", mask)[1].tobytes())
    scores = ["index,name,held_out,stage,psnr,ssim,lpips,detail"]
    write_text(
        folder, "out/scores.csv", scores + [f"{i},{name},0,online,30.5,0.9,,0.8" for i, name in enumerate(NAMES)]
    )
    scene_file(folder, "kind: colmap", "path: images")
    (folder / "out" / "config.yaml").write_text((folder / "scene.yaml").read_text())


def _write_capture(kind: str, folder: Path) -> None:
    """Write the recording as a capture, Record3D's in an archive."""
    views = []
    for i in range(FRAMES):
        T = np.eye(4)
        T[0, 3] = position(i)
        K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
        views.append(View(picture(i), K, T, lambda _, size: np.full(size[::-1], 3.0)))
    place = CAPTURES[kind][0].partition("/")[0]
    WRITERS[kind](folder / ("unpacked" if kind == "record3d" else place), views)
    if kind == "record3d":
        zipped(folder / "unpacked", folder / place)
        shutil.rmtree(folder / "unpacked")
    scene_file(folder, f"kind: {kind}", f"path: {place}")


def _write_bag_with_depths(folder: Path) -> None:
    write_small_bag(folder / BAGS["mcap"], "mcap", depths=True)
    scene_file(folder, "kind: bag, depth: /depth", f"path: {BAGS['mcap']}")


def _write_bag(form: str, folder: Path) -> None:
    write_small_bag(folder / BAGS[form], form)
    scene_file(folder, "kind: bag, points: /map", f"path: {BAGS[form]}")


CAPTURES = {
    "record3d": ("room.r3d",),
    "scanner_app": ("app/frame_00003.json", "app/depth_00003.png"),
    "stray_scanner": ("room/odometry.csv",),
    "polycam": ("room/keyframes/cameras/1733333.json",),
    "nerfcapture": ("room/transforms.json",),
    "euroc": (
        "room/mav0/cam0/sensor.yaml",
        "room/mav0/state_groundtruth_estimate0/data.csv",
        "room/mav0/cam0/data.csv",
    ),
    "kitti": ("room/poses.txt", "room/calib.txt", "room/times.txt"),
    "scannet": (
        "room/pose/1.txt",
        "room/intrinsic/intrinsic_color.txt",
        "room/intrinsic/intrinsic_depth.txt",
        "room/depth/1.png",
    ),
    "arkitscenes": ("room/lowres_wide.traj", "room/lowres_wide_intrinsics/42_3000.101.pincam"),
}
"""The files under test of captures, by kind."""


EXPORT = ("export", "out", "--format", "points", "-o", "written.ply", "--quiet")
RUN_MODEL = tuple(f"out/colmap/{stem}.bin" for stem in ("cameras", "images", "points3D"))
SAMPLES: dict[str, tuple[Sample, Callable[[Path], None]]] = {
    sample.reader: (sample, write)
    for sample, write in (
        (Sample("scene", ("scene.yaml",)), write_scene),
        (
            Sample("colmap_text", tuple(f"sparse/0/{s}.txt" for s in ("cameras", "images", "points3D"))),
            write_colmap_text,
        ),
        (Sample("colmap", tuple(f"sparse/0/{s}.bin" for s in ("cameras", "images", "points3D"))), write_colmap_binary),
        (Sample("transforms", ("transforms.json",)), write_transforms),
        (Sample("tum", ("trajectory.txt", "points.txt")), write_tum),
        (Sample("ply", ("points.ply",)), write_points_ply),
        (Sample("orbslam3", ("CameraTrajectory.txt",)), write_orbslam3),
        (Sample("tum_rgbd", ("rgb.txt",)), write_tum_rgbd),
        (Sample("replica", ("traj.txt",)), write_replica),
        (Sample("matrices", ("poses.txt",)), write_matrices),
        (Sample("tanksandtemples", ("scene.log",)), write_log),
        (Sample("sevenscenes", ("seq/frame-000001.pose.txt",)), write_sevenscenes),
        (
            Sample("modp", ("trajectory.json", "point_cloud/point_cloud_1.txt", "point_cloud/point_cloud_2.npy")),
            write_modp,
        ),
        (
            Sample(
                "aria",
                (
                    "closed_loop_trajectory.csv",
                    "online_calibration.jsonl",
                    "semidense_points.csv.gz",
                    "semidense_observations.csv",
                ),
            ),
            write_aria,
        ),
        (Sample("stella_vslam", ("map.msg",)), write_stella),
        (
            Sample("image", tuple(f"images/{name}" for name in IMAGES)),
            _write_image,
        ),
        (Sample("mask", (f"masks/{NAMES[1]}", "vignette.png")), _write_mask),
        (Sample("video", ("room.mp4",)), _write_video),
        (Sample("run", ("out/splats.ply", "out/trajectory.txt", "out/frames.json", *RUN_MODEL), EXPORT), _write_run),
        *((Sample(kind, files), partial(_write_capture, kind)) for kind, files in CAPTURES.items()),
        *((Sample(f"bag_{form}", (BAGS[form],)), partial(_write_bag, form)) for form in FORMS),
        (Sample("bag_depth", (BAGS["mcap"],)), _write_bag_with_depths),
    )
}


def write_sample(reader: str, folder: Path) -> Sample:
    """Write a reader's input to a new folder."""
    sample, write = SAMPLES[reader]
    folder.mkdir(parents=True)
    write(folder)
    return sample
