"""The examples of docs/trackers.md: every block is valid, and delivers frames from the files that the page lists."""

from __future__ import annotations

import gzip
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from modp_ti.commands import app as cli
from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.inputs.opening import open_tracker
from tests.bags import recording as bag_messages
from tests.bags import write_bag
from tests.captures import WRITERS, View, zipped
from tests.opening import CAPTURES

PAGE = Path(__file__).resolve().parents[4] / "docs" / "trackers.md"
SHARED = Path(__file__).resolve().parents[5] / "shared" / "data"


def blocks() -> dict[str, list[str]]:
    """YAML blocks by the section's name."""
    sections = re.split(r"^## ", PAGE.read_text(), flags=re.MULTILINE)[1:]
    return {text.split("\n", 1)[0].strip(): re.findall(r"```yaml\n(.*?)```", text, re.DOTALL) for text in sections}


EXAMPLES = [(kind, i, text) for kind, texts in blocks().items() for i, text in enumerate(texts)]


@pytest.mark.parametrize(("kind", "number", "text"), EXAMPLES, ids=[f"{kind}-{i}" for kind, i, _ in EXAMPLES])
def test_every_block_is_a_valid_scene_of_its_section(kind, number, text, tmp_path):
    file = tmp_path / "scene.yaml"
    file.write_text(text)
    assert load_scene(file).tracker.kind == kind


def test_every_reader_has_its_page():
    given = ["tum", "orbslam3", "stella_vslam", "aria", "modp", "replica", "sevenscenes", "matrices", "tanksandtemples"]
    sections = {name: texts for name, texts in blocks().items() if not name.startswith("Captures")}
    assert set(sections) == {*given, *CAPTURES, "bag"}
    assert all(texts for texts in sections.values())


def images(recording, folder: Path, size: tuple[int, int], names: Callable[[int], str]) -> None:
    """The plane's views at another size, under other names."""
    folder.mkdir(parents=True)
    for i, name in enumerate(recording.names):
        picture = cv2.imread(str(recording.root / "images" / name))
        cv2.imwrite(str(folder / names(i)), cv2.resize(picture, size, interpolation=cv2.INTER_AREA))


def delivered(root: Path, kind: str, number: int = 0, *overrides: str) -> list:
    """All frames of the example, run in this folder."""
    file = root / "scene.yaml"
    file.write_text(blocks()[kind][number])
    return list(open_tracker(load_scene(file, overrides)))


def from_shared(root: Path, name: str, called: str) -> None:
    if not (SHARED / name).is_dir():
        pytest.skip(f"no ../shared/data/{name}")
    (root / called).symlink_to(SHARED / name)


def test_tum_benchmark(tmp_path):
    from_shared(tmp_path, "tum_fr1_desk", "rgbd_dataset_freiburg1_desk")
    frames = delivered(tmp_path, "tum", 0, "source.stop=2")
    assert [frame.timestamp for frame in frames] == [1305031453.359684, 1305031453.391690]


def test_tum_images_of_ones_own(recording):
    images(recording, recording.root / "large", (640, 480), lambda i: f"{i:04d}.png")
    shutil.rmtree(recording.root / "images")
    (recording.root / "large").rename(recording.root / "images")
    recording.write("trajectory.txt", recording.tum_lines())
    header = ["ply", "format ascii 1.0", "element vertex 60", *(f"property float {axis}" for axis in "xyz")]
    recording.write("points.ply", [*header, "end_header", *(" ".join(map(str, row)) for row in recording.xyz)])
    frames = delivered(recording.root, "tum", 1)
    assert len(frames) == 7 and all(len(frame.points) > 20 for frame in frames)


def test_orbslam3(recording):
    start = 1403636579763555584
    images(recording, recording.root / "MH01/mav0/cam0/data", (752, 480), lambda i: f"{start + 50_000_000 * i}.png")
    lines = [line.split(" ", 1)[1] for line in recording.tum_lines()]
    keyframes = [f"{start + 50_000_000 * i}.000000 {lines[i]}" for i in (0, 2, 5)]
    recording.write("MH01/KeyFrameTrajectory.txt", keyframes)
    recording.write_points("MH01/map_points.txt")
    frames = delivered(recording.root, "orbslam3")
    assert [frame.name for frame in frames] == [f"{start + 50_000_000 * i}.png" for i in (0, 2, 5)]
    assert all(len(frame.points) > 20 for frame in frames)


def test_stella_vslam(tmp_path):
    from_shared(tmp_path, "redkitchen", "redkitchen")
    frames = delivered(tmp_path, "stella_vslam", 0, "source.stop=40")
    assert len(frames) == 14  # frame 0 and those from 27 on
    assert all(len(frame.points) >= 100 for frame in frames)


def test_aria(recording):
    """The second block; the first needs a recording of the glasses."""
    images(recording, recording.root / "rectified", (800, 800), lambda i: f"{i:04d}.png")
    axes = ",".join(f"{axis}_world_device" for axis in ("tx", "ty", "tz", "qx", "qy", "qz", "qw"))
    rows = [f"graph_uid,tracking_timestamp_us,{axes}"]
    for i, T in enumerate(recording.poses_in_world):
        pose = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        rows.append(f"w,{149202610 + 100_000 * i}," + ",".join(f"{x:.9f}" for x in pose))
    recording.write("mps/slam/closed_loop_trajectory.csv", rows)
    mount = {"Translation": [0, 0, 0], "UnitQuaternion": [1, [0, 0, 0]]}
    line = {"tracking_timestamp_us": 1, "CameraCalibrations": [{"Label": "camera-rgb", "T_Device_Camera": mount}]}
    recording.write("mps/slam/online_calibration.jsonl", [json.dumps(line)])
    rows = ["uid,graph_uid,px_world,py_world,pz_world,inv_dist_std,dist_std"]
    rows += [f"{i},w,{x!r},{y!r},{z!r},0.001,0.01" for i, (x, y, z) in enumerate(recording.xyz.tolist())]
    with gzip.open(recording.root / "mps/slam/semidense_points.csv.gz", "wt") as file:
        file.write("\n".join(rows) + "\n")
    frames = delivered(recording.root, "aria", 1)
    assert len(frames) == 7 and all(len(frame.points) > 20 for frame in frames)


def test_modp(recording):
    images(recording, recording.root / "hall/rectified", (800, 800), lambda i: f"{i:04d}.png")
    cameras = [{"T_camera_world": T.tolist(), "image": f"{i:04d}.png"} for i, T in enumerate(recording.T_camera_world)]
    recording.write("hall/trajectory.json", [json.dumps({"cameras": cameras})])
    for i in range(7):
        recording.write_points(f"hall/point_cloud/point_cloud_{i}.txt")
    frames = delivered(recording.root, "modp")
    assert len(frames) == 7 and all(len(frame.points) > 20 for frame in frames)


def test_replica(recording):
    images(recording, recording.root / "room0/results", (1200, 680), lambda i: f"frame{i:06d}.jpg")
    recording.write("room0/traj.txt", [" ".join(map(str, T.ravel())) for T in recording.poses_in_world])
    frames = delivered(recording.root, "replica", 0, "source.stop=2")
    np.testing.assert_allclose([frame.T_camera_world for frame in frames], recording.T_camera_world[:2], atol=1e-9)


def test_sevenscenes(tmp_path):
    from_shared(tmp_path, "redkitchen", "redkitchen")
    assert len(delivered(tmp_path, "sevenscenes", 0, "source.stop=2")) == 2


def test_matrices(recording):
    images(recording, recording.root / "room/images", (640, 480), lambda i: f"{i}.png")
    recording.write("room/poses.txt", [" ".join(map(str, T.ravel())) for T in recording.poses_in_world])
    frames = delivered(recording.root, "matrices", 0, "source.stop=2")
    np.testing.assert_allclose([frame.T_camera_world for frame in frames], recording.T_camera_world[:2], atol=1e-9)


def test_tanksandtemples(recording):
    images(recording, recording.root / "Truck/images", (1957, 1091), lambda i: f"{i + 1:06d}.jpg")
    lines = []
    for i, T in enumerate(recording.poses_in_world):
        lines += [f"{i} {i} 0", *(" ".join(map(str, row)) for row in T)]
    recording.write("Truck/Truck.log", lines)
    frames = delivered(recording.root, "tanksandtemples", 0, "source.stop=2")
    np.testing.assert_allclose([frame.T_camera_world for frame in frames], recording.T_camera_world[:2], atol=1e-9)


@pytest.mark.parametrize("kind", CAPTURES)
def test_captures(recording, kind):
    views = []
    for i in range(2):
        picture = np.asarray(cv2.imread(str(recording.root / "images" / recording.names[i])), np.uint8)
        far = lambda K, size: np.full(size[::-1], 3.0)  # noqa: E731
        views.append(View(picture, recording.K, recording.poses_in_world[i], far))
    path = load_example(recording.root, kind).source.path
    assert path is not None
    WRITERS[kind](recording.root / "unpacked", views)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix:
        zipped(recording.root / "unpacked", path)
    else:
        (recording.root / "unpacked").rename(path)
    frames = delivered(recording.root, kind, 0, "source.step=1")
    np.testing.assert_allclose([frame.T_camera_world for frame in frames], recording.T_camera_world[:2], atol=1e-6)


@pytest.mark.parametrize("number", [0, 1])
def test_bag(recording, number):
    poses = zip(recording.names[:2], recording.poses_in_world, strict=False)
    pictures = ((np.asarray(cv2.imread(str(recording.root / "images" / name)), np.uint8), T) for name, T in poses)
    views = [View(picture, recording.K, T, lambda _, size: np.zeros(size[::-1])) for picture, T in pictures]
    write_bag(recording.root / "corridor.bag", "ros1", bag_messages(views, "ros1"))
    frames = delivered(recording.root, "bag", number)
    np.testing.assert_allclose([frame.T_camera_world for frame in frames], recording.T_camera_world[:2], atol=1e-9)


def load_example(root: Path, kind: str) -> SceneConfig:
    file = root / "scene.yaml"
    file.write_text(blocks()[kind][0])
    return load_scene(file)


def test_what_is_wrong_is_one_line_and_exit_code_2(recording):
    lines = recording.tum_lines()
    recording.write("trajectory.txt", [lines[0], lines[1] + " 7"])
    file = recording.root / "scene.yaml"
    file.write_text(
        "source: {path: images, intrinsics: {fx: 300}}\ntracker: {kind: tum, path: trajectory.txt}\n"
        "output: out\ndevice: cpu\n"
    )
    result = CliRunner().invoke(cli.app, ["run", str(file), "--quiet"])
    assert result.exit_code == 2
    assert "trajectory.txt:2: holds 9 columns instead of 8" in result.stderr
    assert result.stderr.count("\n") == 1 and result.stderr.startswith("error: ")
    assert not (recording.root / "out").exists()
