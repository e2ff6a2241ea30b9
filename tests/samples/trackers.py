"""Writers of the files of trackers and data sets. Each writes a folder with the images and a `scene.yaml`."""

from __future__ import annotations

import gzip
import json
import os
import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import msgpack
import numpy as np
from scipy.spatial.transform import Rotation

from tests.samples.filmed import OPENGL, Filmed, quaternion, rows_of, write_image, write_scene, write_text


def intrinsics(filmed: Filmed) -> str:
    """`intrinsics` of the source."""
    K = filmed.K
    return f"intrinsics: {{fx: {K[0, 0]}, fy: {K[1, 1]}, cx: {K[0, 2]}, cy: {K[1, 2]}}}"


def write_images(folder: Path, filmed: Filmed, inside: str = "images", names: Sequence[str] = ()) -> None:
    """Write the images, under other names if some are given."""
    for view, name in zip(filmed.views, names or filmed.names, strict=True):
        write_image(folder / inside / name, view.image)


def write_points(file: Path, filmed: Filmed) -> None:
    """Write the points as text."""
    write_text(file, [" ".join(map(repr, row)) for row in filmed.points.tolist()])


def write_points_ply(file: Path, filmed: Filmed) -> None:
    """Write the points as a binary PLY."""
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(filmed.points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    file.write_bytes((header + "end_header\n").encode() + filmed.points.astype("<f4").tobytes())


def colmap_text(folder: Path, filmed: Filmed, names: Sequence[str] = ()) -> None:
    """Write a text model to `sparse/0`."""
    K, (width, height) = filmed.K, filmed.size
    camera = f"1 PINHOLE {width} {height} {K[0, 0]:.15g} {K[1, 1]:.15g} {K[0, 2]:.15g} {K[1, 2]:.15g}"
    images, tracks = [], {n: [] for n in range(len(filmed.points))}
    for i, (view, name) in enumerate(zip(filmed.views, names or filmed.names, strict=True)):
        (x, y, z, w), t = quaternion(view.T_camera_world), view.T_camera_world[:3, 3]
        images.append(f"{i + 1} " + " ".join(f"{v:.15g}" for v in (w, x, y, z, *t)) + f" 1 {name}")
        seen, pixels = filmed.seen(i)
        images.append(" ".join(f"{u!r} {v!r} {n + 1}" for n, (u, v) in zip(seen, pixels.tolist(), strict=True)))
        for place, n in enumerate(seen.tolist()):
            tracks[n].append(f"{i + 1} {place}")
    points = [
        f"{n + 1} {x!r} {y!r} {z!r} 200 100 50 0.5 {' '.join(tracks[n])}"
        for n, (x, y, z) in enumerate(filmed.points.tolist())
    ]
    for stem, lines in (("cameras", [camera]), ("images", images), ("points3D", points)):
        write_text(folder / f"sparse/0/{stem}.txt", lines)


def colmap_binary(folder: Path, filmed: Filmed) -> None:
    """Write a binary model to this folder."""
    K, tracks = filmed.K, dict.fromkeys(range(len(filmed.points)), b"")
    cameras = struct.pack("<QiiQQ4d", 1, 1, 1, *filmed.size, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    images = struct.pack("<Q", len(filmed.views))
    for i, (view, name) in enumerate(zip(filmed.views, filmed.names, strict=True)):
        (x, y, z, w), t = quaternion(view.T_camera_world), view.T_camera_world[:3, 3]
        images += struct.pack("<i7di", i + 1, w, x, y, z, *t, 1) + name.encode() + b"\0"
        seen, pixels = filmed.seen(i)
        images += struct.pack("<Q", len(seen))
        images += b"".join(struct.pack("<ddq", *uv, n + 1) for n, uv in zip(seen.tolist(), pixels, strict=True))
        for place, n in enumerate(seen.tolist()):
            tracks[n] += struct.pack("<ii", i + 1, place)
    points = struct.pack("<Q", len(tracks))
    for n, xyz in enumerate(filmed.points):
        points += struct.pack("<Q3d3BdQ", n + 1, *xyz, 200, 100, 50, 0.5, len(tracks[n]) // 8) + tracks[n]
    folder.mkdir(parents=True, exist_ok=True)
    for stem, data in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{stem}.bin").write_bytes(data)


def write_colmap_text(folder: Path, filmed: Filmed) -> None:
    write_images(folder, filmed)
    colmap_text(folder, filmed)
    write_scene(folder, "kind: colmap", "path: images")


def write_colmap(folder: Path, filmed: Filmed) -> None:
    write_images(folder, filmed)
    colmap_binary(folder / "sparse/0", filmed)
    write_scene(folder, "kind: colmap", "path: images")


def write_transforms(folder: Path, filmed: Filmed) -> None:
    write_images(folder, filmed)
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": (view.T_world_camera @ OPENGL).tolist()}
        for name, view in zip(filmed.names, filmed.views, strict=True)
    ]
    K, (width, height) = filmed.K, filmed.size
    data = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": width, "h": height, "frames": frames}
    write_text(folder / "transforms.json", [json.dumps({**data, "ply_file_path": "points.ply"}, indent=1)])
    write_points_ply(folder / "points.ply", filmed)
    write_scene(folder, "kind: transforms", "path: images")


def write_tum(folder: Path, filmed: Filmed) -> None:
    write_images(folder, filmed)
    write_text(folder / "trajectory.txt", ["# time tx ty tz qx qy qz qw", *filmed.tum_lines()])
    write_points(folder / "points.txt", filmed)
    write_scene(folder, "kind: tum, points: points.txt", f"path: images, {intrinsics(filmed)}")


def write_ply(folder: Path, filmed: Filmed) -> None:
    write_tum(folder, filmed)
    write_points_ply(folder / "points.ply", filmed)
    write_scene(folder, "kind: tum, points: points.ply", f"path: images, {intrinsics(filmed)}")


def write_video(folder: Path, filmed: Filmed) -> None:
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read once, at the first use in the process
    write_tum(folder, filmed)
    video = cv2.VideoWriter(str(folder / "room.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, filmed.size)
    for view in filmed.views:
        video.write(view.image)
    video.release()
    write_scene(folder, "kind: tum, points: points.txt", f"path: room.mp4, {intrinsics(filmed)}")


def write_orbslam3(folder: Path, filmed: Filmed) -> None:
    """In nanoseconds, as ORB-SLAM3 writes them for EuRoC."""
    write_images(folder, filmed)
    lines = [line.split(" ", 1)[1] for line in filmed.tum_lines()]
    write_text(
        folder / "CameraTrajectory.txt",
        [f"{1400000000000000000 + i * 50000000}.0 {line}" for i, line in enumerate(lines)],
    )
    write_points(folder / "points.txt", filmed)
    tracker = "kind: orbslam3, points: points.txt, time_offset: -1400000000.0, max_difference: 0.2"
    write_scene(folder, tracker, f"path: images, {intrinsics(filmed)}")


def write_tum_rgbd(folder: Path, filmed: Filmed) -> None:
    write_images(folder, filmed, "rgb")
    write_text(
        folder / "rgb.txt", ["# freiburg1", *(f"{i / 30:.6f} rgb/{name}" for i, name in enumerate(filmed.names))]
    )
    write_text(folder / "groundtruth.txt", filmed.tum_lines())
    write_points(folder / "points.txt", filmed)
    write_scene(folder, "kind: tum, points: points.txt", f"path: ., kind: tum_rgbd, {intrinsics(filmed)}")


def write_replica(folder: Path, filmed: Filmed) -> None:
    write_images(folder, filmed, "results", [f"frame{i:06d}.jpg" for i in range(len(filmed.views))])
    write_text(folder / "traj.txt", [" ".join(rows_of(view.T_world_camera)) for view in filmed.views])
    write_points(folder / "points.txt", filmed)
    write_scene(folder, "kind: replica, points: points.txt", f"path: ., kind: replica, {intrinsics(filmed)}")


def write_replica_depth(folder: Path, filmed: Filmed) -> None:
    """With depth pictures, registered and smaller, in the units of Replica."""
    write_replica(folder, filmed)
    (folder / "points.txt").unlink()
    for place, view in enumerate(filmed.views):
        values = np.round(6553.5 * view.depth_map()).astype(np.uint16)
        write_image(folder / f"depth/depth{place:06d}.png", values)
    tracker = "kind: replica, depth: depth, depth_scale: 6553.5"
    write_scene(folder, tracker, f"path: ., kind: replica, {intrinsics(filmed)}")


def write_matrices(folder: Path, filmed: Filmed) -> None:
    write_images(folder, filmed)
    write_text(folder / "poses.txt", [" ".join(rows_of(view.T_world_camera[:3])) for view in filmed.views])
    write_points(folder / "points.txt", filmed)
    write_scene(folder, "kind: matrices, points: points.txt", f"path: images, {intrinsics(filmed)}")


def write_log(folder: Path, filmed: Filmed) -> None:
    write_images(folder, filmed)
    lines = [line for i, v in enumerate(filmed.views) for line in (f"{i} {i} 0", *rows_of(v.T_world_camera))]
    write_text(folder / "scene.log", lines)
    write_points(folder / "points.txt", filmed)
    write_scene(folder, "kind: tanksandtemples, points: points.txt", f"path: images, {intrinsics(filmed)}")


def write_sevenscenes(folder: Path, filmed: Filmed) -> None:
    write_images(folder, filmed, "seq", [f"frame-{i:06d}.color.png" for i in range(len(filmed.views))])
    for i, view in enumerate(filmed.views):
        write_text(folder / f"seq/frame-{i:06d}.pose.txt", rows_of(view.T_world_camera))
    write_points(folder / "points.txt", filmed)
    write_scene(folder, "kind: sevenscenes, points: points.txt", f"path: seq, kind: sevenscenes, {intrinsics(filmed)}")


def write_modp(folder: Path, filmed: Filmed) -> None:
    """The points of the last frame are an array, those of the others text."""
    write_images(folder, filmed, "rectified")
    cameras, last = [], len(filmed.views) - 1
    for i, (name, view) in enumerate(zip(filmed.names, filmed.views, strict=True)):
        cameras.append({"image": name, "T_camera_world": view.T_camera_world.tolist()})
        cloud = filmed.points[filmed.seen(i)[0]]
        write_text(folder / f"point_cloud/point_cloud_{i}.txt", rows_of(cloud))
        if i == last:
            (folder / f"point_cloud/point_cloud_{i}.txt").unlink()
            np.save(folder / f"point_cloud/point_cloud_{i}.npy", cloud.astype(np.float32))
    write_text(folder / "trajectory.json", [json.dumps({"cameras": cameras}, indent=1)])
    write_scene(folder, "kind: modp", f"path: ., kind: release, {intrinsics(filmed)}")


ARIA_MOUNT = np.eye(4)  # T_device_camera
ARIA_MOUNT[:3, :3] = Rotation.from_euler("xyz", [38, 3, 5], degrees=True).as_matrix()
ARIA_MOUNT[:3, 3] = [-0.004, -0.012, -0.0044]


def aria_calibration(time: int, mount: np.ndarray = ARIA_MOUNT) -> str:
    """A line of online_calibration.jsonl."""
    x, y, z, w = quaternion(mount)
    pose = {"Translation": mount[:3, 3].tolist(), "UnitQuaternion": [w, [x, y, z]]}
    other = {"Translation": [0, 0, 0], "UnitQuaternion": [1, [0, 0, 0]]}
    cameras = [
        {"Label": "camera-slam-left", "T_Device_Camera": other},
        {"Label": "camera-rgb", "T_Device_Camera": pose},
    ]
    return json.dumps({"tracking_timestamp_us": str(time), "CameraCalibrations": cameras})


def write_aria(folder: Path, filmed: Filmed) -> None:
    write_images(folder, filmed)
    axes = [f"{axis}_world_device" for axis in ("tx", "ty", "tz", "qx", "qy", "qz", "qw")]
    header = ["graph_uid", "tracking_timestamp_us", "utc_timestamp_ns", *axes, "quality_score"]
    times, rows = [round(1e6 * i / 30) for i in range(len(filmed.views))], [",".join(header)]
    for time, view in zip(times, filmed.views, strict=True):
        T_world_device = view.T_world_camera @ np.linalg.inv(ARIA_MOUNT)
        pose = [*T_world_device[:3, 3], *quaternion(T_world_device)]
        rows.append(f"g1,{time},0," + ",".join(f"{v:.12g}" for v in pose) + ",1.0")
    write_text(folder / "closed_loop_trajectory.csv", rows)
    write_text(folder / "online_calibration.jsonl", list(map(aria_calibration, times)))
    table = ["uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std"]
    table += [f"{n},g1,{x!r},{y!r},{z!r},0.001,0.01" for n, (x, y, z) in enumerate(filmed.points.tolist())]
    content = gzip.compress(("\n".join(table) + "\n").encode(), mtime=0)
    (folder / "semidense_points.csv.gz").write_bytes(content)
    seen = ["uid,frame_tracking_timestamp_us,camera_serial,u,v"]
    seen += [f"{n},{time},c1,1.0,2.0" for i, time in enumerate(times) for n in filmed.seen(i)[0]]
    write_text(folder / "semidense_observations.csv", seen)
    write_scene(folder, "kind: aria, path: .", f"path: images, {intrinsics(filmed)}")


def stella_map(filmed: Filmed, keyframes: Sequence[int] = ()) -> dict:
    """The map that stella_vslam would hold of these views, or of all. Pixel centres are at whole numbers there."""
    K, (width, height) = filmed.K, filmed.size
    camera = {"model_type": "Perspective", "setup_type": "Monocular", "cols": width, "rows": height, "fps": 30.0}
    camera |= {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] - 0.5, "cy": K[1, 2] - 0.5}
    camera |= dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0)
    stored = {}
    for i in keyframes or range(len(filmed.views)):
        seen, pixels = filmed.seen(i)
        T = filmed.views[i].T_camera_world
        stored[str(i)] = {"ts": i / 30, "cam": "lens", "rot_cw": quaternion(T), "trans_cw": T[:3, 3].tolist()}
        stored[str(i)] |= {"n_keypts": len(seen) + 1, "lm_ids": [-1, *seen.tolist()], "span_parent": -1}
        places = [[1.0, 1.0], *(pixels - 0.5).tolist()]
        stored[str(i)] |= {"undist_keypts": [{"pt": pt, "ang": 0.0, "oct": 0} for pt in places]}
        stored[str(i)] |= {"descs": [[1, 2, 3, 4]] * len(places)}
    landmarks = {str(n): {"pos_w": xyz, "ref_keyfrm": 0, "n_vis": 3} for n, xyz in enumerate(filmed.points.tolist())}
    return {"cameras": {"lens": camera}, "orb_params": {}, "keyframes": stored, "landmarks": landmarks}


def write_stella(folder: Path, filmed: Filmed) -> None:
    write_images(folder, filmed)
    (folder / "map.msg").write_bytes(msgpack.packb(stella_map(filmed)))
    write_text(folder / "frame_trajectory.txt", filmed.tum_lines())
    write_scene(folder, "kind: stella_vslam, path: map.msg", "path: images")
