"""Writers of captures of views, in the layout of every kind. Where a kind has depth maps, their left strip is wrong."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tests.samples.filmed import DEPTH_SIZE, OPENGL, View, quaternion, rows_of, write_image, write_text

# T_body_camera of the sequences in EuRoC's layout.
MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_euler("zyx", [80.0, 10.0, -5.0], degrees=True).as_matrix()
MOUNT[:3, 3] = (0.1, -0.2, 0.05)
# Position of camera 0 in the colour camera's axes, in sequences of KITTI.
KITTI_OFFSET = np.array([0.06, 0.001, 0.003])


def _png(file: Path, values: NDArray, dtype: type) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), np.round(values).astype(dtype))


def _depth(folder: Path, depth: str, confidence: str, view: View, sure: int) -> None:
    """Write depths in millimetres. Those of the left eighth are wrong, and not confident."""
    metres = view.depth_map()
    unsure = np.zeros(metres.shape, dtype=bool)
    unsure[:, : metres.shape[1] // 8] = True
    _png(folder / depth, np.where(unsure, 500.0, 1000.0 * metres), np.uint16)
    _png(folder / confidence, np.where(unsure, sure // 2, sure), np.uint8)


def lzfse_stored(data: bytes) -> bytes:
    """LZFSE data of one block that is not packed."""
    return struct.pack("<4sI", b"bvx-", len(data)) + data + b"bvx$"


def exr_file(values: NDArray, channel: str = "R") -> bytes:
    """An EXR file of one channel of float32 that is not packed, line by line."""
    height, width = values.shape

    def attribute(name: str, kind: str, data: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<I", len(data)) + data

    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = struct.pack("<II", 20000630, 2)
    header += attribute("channels", "chlist", channel.encode() + b"\0" + struct.pack("<4i", 2, 0, 1, 1) + b"\0")
    header += attribute("compression", "compression", b"\0") + attribute("dataWindow", "box2i", box)
    header += attribute("displayWindow", "box2i", box) + attribute("lineOrder", "lineOrder", b"\0")
    header += attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0))
    header += attribute("screenWindowCenter", "v2f", bytes(8))
    header += attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)) + b"\0"
    lines = [struct.pack("<2i", y, 4 * width) + row.astype("<f4").tobytes() for y, row in enumerate(values)]
    first = len(header) + 8 * height
    offsets = b"".join(struct.pack("<Q", first + y * len(lines[0])) for y in range(height))
    return header + offsets + b"".join(lines)


def write_record3d(folder: Path, views: Sequence[View]) -> None:
    """An unpacked archive of the newer kind, with intrinsics and a time for each frame."""
    poses, coefficients = [], []
    for n, view in enumerate(views):
        T = view.T_world_camera @ OPENGL
        poses.append([*quaternion(T), *T[:3, 3].tolist()])
        coefficients.append([view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]])
        write_image(folder / f"rgbd/{n}.jpg", view.image)
        metres = view.depth_map().astype("<f4")
        levels = np.full(metres.shape, 2, np.uint8)
        metres[:, :8], levels[:, :8] = 0.5, 1
        metres[:, -1] = np.nan
        (folder / f"rgbd/{n}.depth").write_bytes(lzfse_stored(metres.tobytes()))
        (folder / f"rgbd/{n}.conf").write_bytes(lzfse_stored(levels.tobytes()))
    width, height = views[0].size
    data = {"w": width, "h": height, "dw": DEPTH_SIZE[0], "dh": DEPTH_SIZE[1], "fps": 60, "K": _columns(views[0].K)}
    data |= {"poses": poses, "perFrameIntrinsicCoeffs": coefficients}
    data |= {"frameTimestamps": [100.0 + n / 30 for n in range(len(views))], "cameraType": 1}
    write_text(folder / "metadata", [json.dumps(data)])


def _columns(K: NDArray[np.float64]) -> list[float]:
    return K.T.ravel().tolist()


def write_scanner_app(folder: Path, views: Sequence[View]) -> None:
    """Every third pose has a picture, as the app writes them."""
    for n, view in enumerate(views):
        number = 3 * n
        scale = 1920 / view.size[0]
        K = np.diag([scale, scale, 1.0]) @ view.K
        pose = (view.T_world_camera @ OPENGL).ravel().tolist()
        data = {"cameraPoseARFrame": pose, "intrinsics": K.ravel().tolist(), "time": 7.0 + number / 60}
        for more in (number, number + 1):
            write_text(folder / f"frame_{more:05d}.json", [json.dumps({**data, "frame_index": more})])
        write_image(folder / f"frame_{number:05d}.jpg", view.image)
        _depth(folder, f"depth_{number:05d}.png", f"conf_{number:05d}.png", view, 2)


def write_stray_scanner(folder: Path, views: Sequence[View]) -> None:
    """The newer table, whose last two columns are empty."""
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, distortion_center_x, distortion_center_y"]
    folder.mkdir(parents=True, exist_ok=True)
    video = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, views[0].size)
    for n, view in enumerate(views):
        scale = 1920 / view.size[0]
        focal = [scale * view.K[0, 0], scale * view.K[1, 1], scale * view.K[0, 2], scale * view.K[1, 2]]
        numbers = [*view.T_world_camera[:3, 3], *quaternion(view.T_world_camera), *focal]
        lines.append(f"{500 + n / 60:.6f}, {n:06d}, " + ", ".join(f"{value:.12g}" for value in numbers) + ", , ")
        video.write(view.image)
        _depth(folder, f"depth/{n:06d}.png", f"confidence/{n:06d}.png", view, 2)
    video.release()
    write_text(folder / "odometry.csv", lines)


def write_polycam(folder: Path, views: Sequence[View]) -> None:
    """A raw export without corrected poses."""
    for n, view in enumerate(views):
        stem = 1_700_000 + 33_333 * n
        T = view.T_world_camera @ OPENGL
        camera = {f"t_{row}{column}": T[row, column] for row in range(3) for column in range(4)}
        camera |= {"fx": view.K[0, 0], "fy": view.K[1, 1], "cx": view.K[0, 2], "cy": view.K[1, 2]}
        camera |= {"width": view.size[0], "height": view.size[1], "blur_score": 90.0}
        write_text(folder / f"keyframes/cameras/{stem}.json", [json.dumps(camera)])
        write_image(folder / f"keyframes/images/{stem}.jpg", view.image)
        _depth(folder, f"keyframes/depth/{stem}.png", f"keyframes/confidence/{stem}.png", view, 255)
    write_text(folder / "mesh_info.json", ["{}"])


def write_nerfcapture(folder: Path, views: Sequence[View]) -> None:
    """Frames out of order, named without suffix, with depth pictures that are of no use."""
    frames = []
    for n, view in enumerate(views):
        frame = {"file_path": f"images/{n}", "depth_path": f"images/{n}.depth.png", "timestamp": 30.0 + n / 10}
        frame |= {"fl_x": view.K[0, 0], "fl_y": view.K[1, 1], "cx": view.K[0, 2], "cy": view.K[1, 2]}
        frames.append(frame | {"transform_matrix": (view.T_world_camera @ OPENGL).tolist()})
        write_image(folder / f"images/{n}.png", view.image)
        _png(folder / f"images/{n}.depth.png", np.full((48, 64), 7), np.uint8)
    width, height = views[0].size
    write_text(folder / "transforms.json", [json.dumps({"w": width, "h": height, "frames": [*frames[1:], frames[0]]})])


def write_euroc(folder: Path, views: Sequence[View]) -> None:
    """Truth of the body, 200 poses a second."""
    start = 1_403_715_273_262_142_976
    listing, truth = ["#timestamp [ns],filename"], ["#time(ns),px,py,pz,qw,qx,qy,qz,vx,vy,vz"]
    for n, view in enumerate(views):
        time = start + 50_000_000 * n
        write_image(folder / f"mav0/cam0/data/{time}.png", view.image)
        listing.append(f"{time},{time}.png")
        T = view.T_world_camera @ np.linalg.inv(MOUNT)
        x, y, z, w = quaternion(T)
        numbers = [*T[:3, 3], w, x, y, z, 0, 0, 0]
        truth.append(f"{time + 2_000_000}," + ",".join(f"{value:.12g}" for value in numbers))
        far = ",".join(f"{value:.12g}" for value in [*(T[:3, 3] + 5.0), w, x, y, z, 0, 0, 0])
        truth.append(f"{time + 7_000_000},{far}")
    K, (width, height) = views[0].K, views[0].size
    write_text(folder / "mav0/cam0/data.csv", listing)
    write_text(folder / "mav0/state_groundtruth_estimate0/data.csv", truth)
    numbers = ", ".join(f"{value:.12g}" for value in MOUNT.ravel())
    lines = [
        "%YAML:1.0\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4",
        f"  data: [{numbers}]\nresolution: [{width}, {height}]\ncamera_model: pinhole",
        f"intrinsics: [{K[0, 0]}, {K[1, 1]}, {K[0, 2] - 0.5}, {K[1, 2] - 0.5}] #fu, fv, cu, cv",
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]",
    ]
    write_text(folder / "mav0/cam0/sensor.yaml", lines)


def write_kitti(folder: Path, views: Sequence[View]) -> None:
    """The colour camera, beside the left grey one whose poses are in the file."""
    K = views[0].K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    grey, colour = np.hstack([K, np.zeros((3, 1))]), np.hstack([K, (K @ KITTI_OFFSET)[:, None]])
    lines = [f"P{n}: " + " ".join(f"{value:.12e}" for value in P.ravel()) for n, P in ((0, grey), (2, colour))]
    write_text(folder / "calib.txt", lines)
    poses = []
    T_colour_grey = np.eye(4)
    T_colour_grey[:3, 3] = KITTI_OFFSET
    for n, view in enumerate(views):
        write_image(folder / f"image_2/{n:06d}.png", view.image)
        poses.append(" ".join(f"{value:.12e}" for value in (view.T_world_camera @ T_colour_grey)[:3].ravel()))
    write_text(folder / "times.txt", [f"{n / 10:e}" for n in range(len(views))])
    write_text(folder / "poses.txt", poses)


def write_scannet(folder: Path, views: Sequence[View]) -> None:
    """The depth camera has another field of view."""
    K = np.diag([*np.divide(DEPTH_SIZE, views[0].size), 1.0]) @ views[0].K
    K[0, 0] *= 0.9
    K[0, 2] += 2.0
    for n, view in enumerate(views):
        write_image(folder / f"color/{n}.jpg", view.image)
        _png(folder / f"depth/{n}.png", 1000.0 * view.depth(K, DEPTH_SIZE), np.uint16)
        write_text(folder / f"pose/{n}.txt", rows_of(view.T_world_camera))
    for name, matrix in (("color", views[0].K), ("depth", K)):
        full = np.eye(4)
        full[:3, :3] = matrix
        write_text(folder / f"intrinsic/intrinsic_{name}.txt", rows_of(full))


def write_arkitscenes(folder: Path, views: Sequence[View]) -> None:
    """Times of intrinsics and poses differ a little from those of the images."""
    rows = []
    for n, view in enumerate(views):
        time = 3000 + n / 10
        T = np.linalg.inv(view.T_world_camera)
        numbers = [time + 0.004, *Rotation.from_matrix(T[:3, :3]).as_rotvec(), *T[:3, 3]]
        rows.append(" ".join(f"{value:.12g}" for value in numbers))
        write_image(folder / f"lowres_wide/42_{time:.3f}.png", view.image)
        _depth(folder, f"lowres_depth/42_{time:.3f}.png", f"confidence/42_{time:.3f}.png", view, 2)
        K = " ".join(f"{value:.12g}" for value in (*view.size, view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]))
        write_text(folder / f"lowres_wide_intrinsics/42_{time + 0.001:.3f}.pincam", [K])
    write_text(folder / "lowres_wide.traj", rows)


WRITERS: dict[str, Callable[[Path, Sequence[View]], None]] = {
    "record3d": write_record3d,
    "scanner_app": write_scanner_app,
    "stray_scanner": write_stray_scanner,
    "polycam": write_polycam,
    "nerfcapture": write_nerfcapture,
    "euroc": write_euroc,
    "kitti": write_kitti,
    "scannet": write_scannet,
    "arkitscenes": write_arkitscenes,
}
"""Functions that write a capture of each kind to a folder."""


def zipped(folder: Path, file: Path, top: str = "") -> Path:
    """Pack a folder's files, all of them below the folder `top` in the archive if one is given."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for each in sorted(folder.rglob("*")):
            if each.is_file():
                archive.write(each, f"{top}/{each.relative_to(folder)}" if top else each.relative_to(folder))
    return file
