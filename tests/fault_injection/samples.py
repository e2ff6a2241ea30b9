"""Small valid inputs of every reader, from which the malformed inputs are made."""

from __future__ import annotations

import gzip
import json
import os
import shutil
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import cv2
import msgpack
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
    pixels_on,
    points_file,
    points_ply,
    position,
    scene_file,
    seen_on,
    tum_line,
    wall,
    write_bytes,
    write_images,
    write_text,
)

__all__ = ["CAPTURES", "SAMPLES", "SPLATS", "Sample", "write_sample"]


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


def _colmap_text(folder: Path, names: list[str] = NAMES) -> None:
    write_text(folder, "sparse/0/cameras.txt", [f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}"])
    images, tracks = [], {n: [] for n in range(40)}
    for i, name in enumerate(names):
        images.append(f"{i + 1} 1 0 0 0 {-position(i)} 0 0 1 {name}")
        pixels, seen = pixels_on(i), seen_on(i)
        images.append(" ".join(f"{pixels[n, 0]:.4f} {pixels[n, 1]:.4f} {n + 1}" for n in seen))
        for place, n in enumerate(seen):
            tracks[n].append(f"{i + 1} {place}")
    write_text(folder, "sparse/0/images.txt", images)
    points = [
        f"{n + 1} {x:.6f} {y:.6f} {z:.6f} 200 100 50 0.5 {' '.join(tracks[n])}"
        for n, (x, y, z) in enumerate(wall())
        if len(tracks[n]) > 1
    ]
    write_text(folder, "sparse/0/points3D.txt", points)


def _colmap_binary(folder: Path, names: list[str] = NAMES, inside: str = "sparse/0") -> None:
    cameras = struct.pack("<QiiQQ4d", 1, 1, 1, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    images, tracks = struct.pack("<Q", len(names)), dict.fromkeys(range(40), b"")
    for i, name in enumerate(names):
        images += struct.pack("<i7di", i + 1, 1, 0, 0, 0, -position(i), 0, 0, 1) + name.encode() + b"\0"
        pixels, seen = pixels_on(i), seen_on(i)
        images += struct.pack("<Q", len(seen)) + b"".join(struct.pack("<ddq", *pixels[n], n + 1) for n in seen)
        for place, n in enumerate(seen):
            tracks[n] += struct.pack("<ii", i + 1, place)
    points = struct.pack("<Q", len(tracks))
    for n, xyz in enumerate(wall()):
        points += struct.pack("<Q3d3BdQ", n + 1, *xyz, 200, 100, 50, 0.5, len(tracks[n]) // 8) + tracks[n]
    for stem, data in (("cameras", cameras), ("images", images), ("points3D", points)):
        write_bytes(folder, f"{inside}/{stem}.bin", data)


def _write_scene(folder: Path) -> None:
    write_images(folder)
    _colmap_text(folder)
    write_text(
        folder,
        "scene.yaml",
        ["source:", "  path: images", "  scale: 1.0", "tracker:", "  kind: colmap", "output: out", "device: cpu"],
    )


def _write_colmap_text(folder: Path) -> None:
    write_images(folder)
    _colmap_text(folder)
    scene_file(folder, "kind: colmap", "path: images")


def _write_colmap_binary(folder: Path) -> None:
    write_images(folder)
    _colmap_binary(folder)
    scene_file(folder, "kind: colmap", "path: images")


def _write_transforms(folder: Path) -> None:
    write_images(folder)
    frames = []
    for i, name in enumerate(NAMES):
        rows = [[1.0, 0.0, 0.0, position(i)], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        frames.append({"file_path": f"images/{name}", "transform_matrix": rows})
    data = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT, "frames": frames}
    write_text(folder, "transforms.json", [json.dumps({**data, "ply_file_path": "points.ply"}, indent=1)])
    write_bytes(folder, "points.ply", points_ply())
    scene_file(folder, "kind: transforms", "path: images")


def _write_tum(folder: Path) -> None:
    write_images(folder)
    write_text(folder, "trajectory.txt", ["# time tx ty tz qx qy qz qw", *(tum_line(i) for i in range(FRAMES))])
    points_file(folder)
    scene_file(folder, "kind: tum, points: points.txt")


def _write_points_ply(folder: Path) -> None:
    _write_tum(folder)
    write_bytes(folder, "points.ply", points_ply())
    scene_file(folder, "kind: tum, points: points.ply")


def _write_orbslam3(folder: Path) -> None:
    write_images(folder)
    lines = [f"{1400000000000000000 + i * 50000000}.0 {position(i)} 0 0 0 0 0 1" for i in range(FRAMES)]
    write_text(folder, "CameraTrajectory.txt", lines)
    points_file(folder)
    scene_file(folder, "kind: orbslam3, points: points.txt, time_offset: -1400000000.0, max_difference: 0.2")


def _write_tum_rgbd(folder: Path) -> None:
    write_images(folder, inside="rgb")
    write_text(folder, "rgb.txt", ["# freiburg1", *(f"{i / 30:.6f} rgb/{name}" for i, name in enumerate(NAMES))])
    write_text(folder, "groundtruth.txt", [tum_line(i) for i in range(FRAMES)])
    points_file(folder)
    scene_file(folder, "kind: tum, points: points.txt", f"path: ., kind: tum_rgbd, {INTRINSICS}")


def _matrix(i: int) -> list[str]:
    return [f"1 0 0 {position(i)}", "0 1 0 0", "0 0 1 0", "0 0 0 1"]


def _write_replica(folder: Path) -> None:
    write_images(folder, [f"frame{i:06d}.jpg" for i in range(FRAMES)], "results")
    write_text(folder, "traj.txt", [" ".join(_matrix(i)) for i in range(FRAMES)])
    points_file(folder)
    scene_file(folder, "kind: replica, points: points.txt", f"path: ., kind: replica, {INTRINSICS}")


def _write_matrices(folder: Path) -> None:
    write_images(folder)
    write_text(folder, "poses.txt", [" ".join(_matrix(i)[:3]) for i in range(FRAMES)])
    points_file(folder)
    scene_file(folder, "kind: matrices, points: points.txt")


def _write_log(folder: Path) -> None:
    write_images(folder)
    write_text(folder, "scene.log", [line for i in range(FRAMES) for line in (f"{i} {i} 0", *_matrix(i))])
    points_file(folder)
    scene_file(folder, "kind: tanksandtemples, points: points.txt")


def _write_sevenscenes(folder: Path) -> None:
    write_images(folder, inside="seq")
    for i in range(FRAMES):
        write_text(folder, f"seq/frame-{i:06d}.pose.txt", _matrix(i))
    points_file(folder)
    scene_file(folder, "kind: sevenscenes, points: points.txt", f"path: seq, kind: sevenscenes, {INTRINSICS}")


def _write_modp(folder: Path) -> None:
    write_images(folder, inside="rectified")
    cameras = []
    for i, name in enumerate(NAMES):
        rows = [[1.0, 0.0, 0.0, -position(i)], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        cameras.append({"image": name, "T_camera_world": rows})
        cloud = [" ".join(f"{v:.6f}" for v in row) for row in wall()[seen_on(i)]]
        if i < 2:
            write_text(folder, f"point_cloud/point_cloud_{i}.txt", cloud)
    with (folder / "point_cloud" / "point_cloud_2.npy").open("wb") as file:
        np.save(file, wall()[seen_on(2)].astype(np.float32))
    write_text(folder, "trajectory.json", [json.dumps({"cameras": cameras}, indent=1)])
    scene_file(folder, "kind: modp", f"path: ., kind: release, {INTRINSICS}")


def _write_aria(folder: Path) -> None:
    write_images(folder)
    axes = [f"{axis}_world_device" for axis in ("tx", "ty", "tz", "qx", "qy", "qz", "qw")]
    header = ["graph_uid", "tracking_timestamp_us", "utc_timestamp_ns", *axes, "quality_score"]
    rows = [f"g1,{round(1e6 * i / 30)},0,{position(i)},0,0,0,0,0,1,1.0" for i in range(FRAMES)]
    write_text(folder, "closed_loop_trajectory.csv", [",".join(header), *rows])
    mount = {"Translation": [0.0, 0.0, 0.0], "UnitQuaternion": [1.0, [0.0, 0.0, 0.0]]}
    lines = [
        json.dumps(
            {
                "tracking_timestamp_us": str(round(1e6 * i / 30)),
                "CameraCalibrations": [{"Label": "camera-rgb", "T_Device_Camera": mount}],
            }
        )
        for i in range(FRAMES)
    ]
    write_text(folder, "online_calibration.jsonl", lines)
    table = ["uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std"]
    table += [f"{n},g1,{x:.5f},{y:.5f},{z:.5f},0.001,0.01" for n, (x, y, z) in enumerate(wall())]
    write_bytes(folder, "semidense_points.csv.gz", gzip.compress(("\n".join(table) + "\n").encode(), mtime=0))
    seen = ["uid,frame_tracking_timestamp_us,camera_serial,u,v"]
    seen += [f"{n},{round(1e6 * i / 30)},c1,1.0,2.0" for i in range(FRAMES) for n in seen_on(i)]
    write_text(folder, "semidense_observations.csv", seen)
    scene_file(folder, "kind: aria, path: .")


def _stella_map() -> dict:
    camera = {"model_type": "Perspective", "setup_type": "Monocular", "cols": WIDTH, "rows": HEIGHT, "fps": 30.0}
    camera |= {"fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2 - 0.5, "cy": HEIGHT / 2 - 0.5}
    camera |= dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0)
    keyframes = {}
    for i in range(FRAMES):
        pixels, seen = pixels_on(i), seen_on(i)
        keyframes[str(i)] = {
            "ts": i / 30,
            "cam": "lens",
            "rot_cw": [0.0, 0.0, 0.0, 1.0],
            "trans_cw": [-position(i), 0.0, 0.0],
            "n_keypts": len(seen),
            "undist_keypts": [{"pt": (pixels[n] - 0.5).tolist(), "ang": 0.0, "oct": 0} for n in seen],
            "lm_ids": seen.tolist(),
            "descs": [[1, 2, 3, 4] for _ in seen],
            "span_parent": -1,
        }
    landmarks = {
        str(n): {"1st_keyfrm": 0, "pos_w": xyz.tolist(), "ref_keyfrm": 0, "n_vis": 3, "n_fnd": 3}
        for n, xyz in enumerate(wall())
    }
    return {"cameras": {"lens": camera}, "orb_params": {}, "keyframes": keyframes, "landmarks": landmarks}


def _write_stella(folder: Path) -> None:
    write_images(folder)
    write_bytes(folder, "map.msg", msgpack.packb(_stella_map()))
    write_text(folder, "frame_trajectory.txt", [tum_line(i) for i in range(FRAMES)])
    scene_file(folder, "kind: stella_vslam, path: map.msg", "path: images")


IMAGES = ["0.png", "1.jpg", "2.bmp", "3.tiff", "4.webp", "5.ppm", "6.avif"]
if find_spec("pillow_heif") is not None:
    IMAGES.append("7.heic")


def _write_image(folder: Path) -> None:
    write_images(folder, IMAGES)
    _colmap_text(folder, IMAGES)
    scene_file(folder, "kind: colmap", "path: images")


def _write_mask(folder: Path) -> None:
    write_images(folder)
    _colmap_text(folder)
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
    _write_colmap_binary(folder)
    _colmap_binary(folder, inside="out/colmap")
    write_bytes(folder, "out/splats.ply", splats())
    write_text(folder, "out/trajectory.txt", [tum_line(i) for i in range(FRAMES)])
    write_text(folder, "path.txt", [tum_line(i) for i in range(FRAMES)])
    record = {"near": 0.1, "scene_depth": 3.0, "keyframes": [0, 2], "held_out": [1]}
    write_text(folder, "out/frames.json", [json.dumps(record)])
    matrix = np.eye(3, 4).tolist()
    frames = [{"index": i, "timestamp": i / 30, "keyframe": True, "matrix": matrix} for i in range(FRAMES)]
    write_text(folder, "out/exposure.json", [json.dumps({"frames": frames})])
    scores = ["index,name,held_out,stage,psnr,ssim,lpips,detail"]
    write_text(
        folder, "out/scores.csv", scores + [f"{i},{name},0,online,30.5,0.9,,0.8" for i, name in enumerate(NAMES)]
    )
    scene_file(folder, "kind: colmap", "path: images")
    (folder / "out" / "config.yaml").write_text((folder / "scene.yaml").read_text())


def _write_weights(folder: Path) -> None:
    import torch

    _write_colmap_text(folder)
    torch.save({"lin0.model.1.weight": torch.ones(1, 4, 1, 1)}, folder / "weights.pth")
    older = {"lin0.model.1.weight": torch.ones(1, 4, 1, 1), "more": torch.zeros(3)}
    torch.save(older, folder / "older.pth", _use_new_zipfile_serialization=False)


def _message(kind: int, payload: bytes = b"") -> bytes:
    return struct.pack("<4sHHII", b"MODP", 1, kind, len(payload), 0) + payload


def wire() -> bytes:
    """Return a tracker's messages to the tracker server: three frames, a late pose and a correction."""
    lens = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, *[0.0] * 8]
    data = _message(1, struct.pack("<IIII12d", WIDTH, HEIGHT, 1, 0, *lens) + b"a tracker")
    poses = []
    for i in range(FRAMES):
        T = np.eye(4)
        T[0, 3] = -position(i)
        poses.append(T)
        late = i == 1
        matrix = np.zeros((4, 4)) if late else T
        points = b"".join(struct.pack("<q5d", n, *wall()[n], *pixels_on(i)[n]) for n in seen_on(i)[:5])
        image = cv2.imencode(".jpg", picture(i))[1].tobytes()
        head = struct.pack("<IId16d", i, 0 if late else 1, i / 30, *matrix.ravel())
        block = b"" if late else points
        data += _message(2, head + struct.pack("<II", len(block) // 48, len(image)) + block + image)
        if late:
            head = struct.pack("<IId16dII", i, 1, 0.0, *T.ravel(), len(points) // 48, 0)
            data += _message(3, head + points)
    moved = struct.pack("<IIII16d", 1, 1, 0, 0, *poses[0].ravel()) + struct.pack("<q3d", 1, 0.0, 0.0, 3.0)
    return data + _message(4, moved) + _message(5)


def _write_tracker_server(folder: Path) -> None:
    write_bytes(folder, "wire", wire())


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


SPLATS = {
    "spz": "a.spz",
    "sog": "a.sog",
    "splat": "a.splat",
    "ksplat": "a.ksplat",
    "compressed_ply": "a.compressed.ply",
}
"""The files of splats of other programs, by reader."""


def _write_splats(file: str, folder: Path) -> None:
    from modp_ti.outputs.formats.splat_files import convert_splats

    write_bytes(folder, "source.ply", splats())
    convert_splats(folder / "source.ply", folder / file)


EXPORT = ("export", "out", "--format", "points", "-o", "written.ply", "--quiet")
RUN_MODEL = tuple(f"out/colmap/{stem}.bin" for stem in ("cameras", "images", "points3D"))
SAMPLES: dict[str, tuple[Sample, Callable[[Path], None]]] = {
    sample.reader: (sample, write)
    for sample, write in (
        (Sample("scene", ("scene.yaml",)), _write_scene),
        (
            Sample("colmap_text", tuple(f"sparse/0/{s}.txt" for s in ("cameras", "images", "points3D"))),
            _write_colmap_text,
        ),
        (Sample("colmap", tuple(f"sparse/0/{s}.bin" for s in ("cameras", "images", "points3D"))), _write_colmap_binary),
        (Sample("transforms", ("transforms.json",)), _write_transforms),
        (Sample("tum", ("trajectory.txt", "points.txt")), _write_tum),
        (Sample("ply", ("points.ply",)), _write_points_ply),
        (Sample("orbslam3", ("CameraTrajectory.txt",)), _write_orbslam3),
        (Sample("tum_rgbd", ("rgb.txt",)), _write_tum_rgbd),
        (Sample("replica", ("traj.txt",)), _write_replica),
        (Sample("matrices", ("poses.txt",)), _write_matrices),
        (Sample("tanksandtemples", ("scene.log",)), _write_log),
        (Sample("sevenscenes", ("seq/frame-000001.pose.txt",)), _write_sevenscenes),
        (
            Sample("modp", ("trajectory.json", "point_cloud/point_cloud_1.txt", "point_cloud/point_cloud_2.npy")),
            _write_modp,
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
            _write_aria,
        ),
        (Sample("stella_vslam", ("map.msg",)), _write_stella),
        (
            Sample("image", tuple(f"images/{name}" for name in IMAGES)),
            _write_image,
        ),
        (Sample("mask", (f"masks/{NAMES[1]}", "vignette.png")), _write_mask),
        (Sample("video", ("room.mp4",)), _write_video),
        (Sample("run", ("out/splats.ply", "out/trajectory.txt", "out/frames.json", *RUN_MODEL), EXPORT), _write_run),
        (Sample("weights", ("weights.pth", "older.pth")), _write_weights),
        (Sample("tracker_server", ("wire",), ()), _write_tracker_server),
        *((Sample(kind, files), partial(_write_capture, kind)) for kind, files in CAPTURES.items()),
        *((Sample(f"bag_{form}", (BAGS[form],)), partial(_write_bag, form)) for form in FORMS),
        *(
            (Sample(form, (file,), ("convert", file, "written.ply", "--quiet")), partial(_write_splats, file))
            for form, file in SPLATS.items()
        ),
    )
}


def write_sample(reader: str, folder: Path) -> Sample:
    """Write a reader's input to a new folder."""
    sample, write = SAMPLES[reader]
    folder.mkdir(parents=True)
    write(folder)
    return sample
