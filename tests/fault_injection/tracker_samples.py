"""Small valid inputs of the trackers that read files: models, trajectories and data sets."""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path

import msgpack
import numpy as np

from tests.fault_injection.small_recording import (
    FOCAL,
    FRAMES,
    HEIGHT,
    INTRINSICS,
    NAMES,
    WIDTH,
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


def colmap_text(folder: Path, names: list[str] = NAMES) -> None:
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


def colmap_binary(folder: Path, names: list[str] = NAMES, inside: str = "sparse/0") -> None:
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


def write_scene(folder: Path) -> None:
    write_images(folder)
    colmap_text(folder)
    write_text(
        folder,
        "scene.yaml",
        ["source:", "  path: images", "  scale: 1.0", "tracker:", "  kind: colmap", "output: out", "device: cpu"],
    )


def write_colmap_text(folder: Path) -> None:
    write_images(folder)
    colmap_text(folder)
    scene_file(folder, "kind: colmap", "path: images")


def write_colmap_binary(folder: Path) -> None:
    write_images(folder)
    colmap_binary(folder)
    scene_file(folder, "kind: colmap", "path: images")


def write_transforms(folder: Path) -> None:
    write_images(folder)
    frames = []
    for i, name in enumerate(NAMES):
        rows = [[1.0, 0.0, 0.0, position(i)], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        frames.append({"file_path": f"images/{name}", "transform_matrix": rows})
    data = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT, "frames": frames}
    write_text(folder, "transforms.json", [json.dumps({**data, "ply_file_path": "points.ply"}, indent=1)])
    write_bytes(folder, "points.ply", points_ply())
    scene_file(folder, "kind: transforms", "path: images")


def write_tum(folder: Path) -> None:
    write_images(folder)
    write_text(folder, "trajectory.txt", ["# time tx ty tz qx qy qz qw", *(tum_line(i) for i in range(FRAMES))])
    points_file(folder)
    scene_file(folder, "kind: tum, points: points.txt")


def write_points_ply(folder: Path) -> None:
    write_tum(folder)
    write_bytes(folder, "points.ply", points_ply())
    scene_file(folder, "kind: tum, points: points.ply")


def write_orbslam3(folder: Path) -> None:
    write_images(folder)
    lines = [f"{1400000000000000000 + i * 50000000}.0 {position(i)} 0 0 0 0 0 1" for i in range(FRAMES)]
    write_text(folder, "CameraTrajectory.txt", lines)
    points_file(folder)
    scene_file(folder, "kind: orbslam3, points: points.txt, time_offset: -1400000000.0, max_difference: 0.2")


def write_tum_rgbd(folder: Path) -> None:
    write_images(folder, inside="rgb")
    write_text(folder, "rgb.txt", ["# freiburg1", *(f"{i / 30:.6f} rgb/{name}" for i, name in enumerate(NAMES))])
    write_text(folder, "groundtruth.txt", [tum_line(i) for i in range(FRAMES)])
    points_file(folder)
    scene_file(folder, "kind: tum, points: points.txt", f"path: ., kind: tum_rgbd, {INTRINSICS}")


def _matrix(i: int) -> list[str]:
    return [f"1 0 0 {position(i)}", "0 1 0 0", "0 0 1 0", "0 0 0 1"]


def write_replica(folder: Path) -> None:
    write_images(folder, [f"frame{i:06d}.jpg" for i in range(FRAMES)], "results")
    write_text(folder, "traj.txt", [" ".join(_matrix(i)) for i in range(FRAMES)])
    points_file(folder)
    scene_file(folder, "kind: replica, points: points.txt", f"path: ., kind: replica, {INTRINSICS}")


def write_matrices(folder: Path) -> None:
    write_images(folder)
    write_text(folder, "poses.txt", [" ".join(_matrix(i)[:3]) for i in range(FRAMES)])
    points_file(folder)
    scene_file(folder, "kind: matrices, points: points.txt")


def write_log(folder: Path) -> None:
    write_images(folder)
    write_text(folder, "scene.log", [line for i in range(FRAMES) for line in (f"{i} {i} 0", *_matrix(i))])
    points_file(folder)
    scene_file(folder, "kind: tanksandtemples, points: points.txt")


def write_sevenscenes(folder: Path) -> None:
    write_images(folder, inside="seq")
    for i in range(FRAMES):
        write_text(folder, f"seq/frame-{i:06d}.pose.txt", _matrix(i))
    points_file(folder)
    scene_file(folder, "kind: sevenscenes, points: points.txt", f"path: seq, kind: sevenscenes, {INTRINSICS}")


def write_modp(folder: Path) -> None:
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


def write_aria(folder: Path) -> None:
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


def write_stella(folder: Path) -> None:
    write_images(folder)
    write_bytes(folder, "map.msg", msgpack.packb(_stella_map()))
    write_text(folder, "frame_trajectory.txt", [tum_line(i) for i in range(FRAMES)])
    scene_file(folder, "kind: stella_vslam, path: map.msg", "path: images")
