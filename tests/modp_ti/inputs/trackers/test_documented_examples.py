"""The examples of docs/trackers.md: every block is valid, and delivers frames from the files that the page lists."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.config.settings import SceneConfig
from modp_ti.inputs.opening import open_tracker
from tests.opening import CAPTURES
from tests.samples.bags import recording as bag_messages
from tests.samples.bags import write_bag
from tests.samples.captures import WRITERS, zipped
from tests.samples.filmed import write_image, write_text
from tests.samples.kinds import write_sample

PAGE = Path(__file__).resolve().parents[4] / "docs" / "trackers.md"


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


SHARED_DATA = {"tum": "rgbd_dataset_freiburg1_desk", "stella_vslam": "redkitchen", "sevenscenes": "redkitchen"}
NAMES = {  # of the images, where the writers of samples have others or the section needs others
    "orbslam3": lambda i: f"MH01/mav0/cam0/data/{1403636579763555584 + 50_000_000 * i}.png",
    "modp": lambda i: f"hall/rectified/{i:04d}.png",
    "replica": lambda i: f"room0/results/frame{i:06d}.jpg",
    "matrices": lambda i: f"room/images/{i}.png",
    "tanksandtemples": lambda i: f"Truck/images/{i + 1:06d}.jpg",
    "aria": lambda i: f"rectified/{i:04d}.png",
    "tum": lambda i: f"images/{i:04d}.png",
}
SIZES = {"orbslam3": (752, 480), "modp": (800, 800), "replica": (1200, 680), "tanksandtemples": (1957, 1091)}
SIZES |= {"aria": (800, 800), "matrices": (640, 480), "tum": (640, 480)}


def move(folder: Path, files: dict[str, str]) -> None:
    for old, new in files.items():
        (folder / new).parent.mkdir(parents=True, exist_ok=True)
        (folder / old).rename(folder / new)


# Where the files of a sample lie in the section's example, and which block it is.
MOVED = {
    "tum": ({"trajectory.txt": "trajectory.txt", "points.ply": "points.ply"}, 1),
    "orbslam3": ({"CameraTrajectory.txt": "MH01/KeyFrameTrajectory.txt", "points.txt": "MH01/map_points.txt"}, 0),
    "modp": ({"trajectory.json": "hall/trajectory.json", "point_cloud": "hall/point_cloud"}, 0),
    "replica": ({"traj.txt": "room0/traj.txt"}, 0),
    "matrices": ({"poses.txt": "room/poses.txt"}, 0),
    "tanksandtemples": ({"scene.log": "Truck/Truck.log"}, 0),
}


@pytest.mark.parametrize("kind", MOVED)
def test_the_example_reads_the_files_of_its_section(filmed, tmp_path, kind):
    """The frames have the poses of the sample, and its points where the section has some."""
    write_sample("ply" if kind == "tum" else kind, tmp_path / "a", filmed)
    files, number = MOVED[kind]
    for folder in ("images", "rectified", "results"):
        shutil.rmtree(tmp_path / "a" / folder, ignore_errors=True)
    move(tmp_path / "a", files)
    for i, view in enumerate(filmed.views):
        write_image(tmp_path / "a" / NAMES[kind](i), cv2.resize(view.image, SIZES[kind], interpolation=cv2.INTER_AREA))
    if kind == "modp":
        file = tmp_path / "a/hall/trajectory.json"
        cameras = json.loads(file.read_text())["cameras"]
        file.write_text(json.dumps({"cameras": [c | {"image": f"{i:04d}.png"} for i, c in enumerate(cameras)]}))
    if kind == "orbslam3":  # its times are those of the images' names
        file = tmp_path / "a/MH01/KeyFrameTrajectory.txt"
        file.write_text(file.read_text().replace("\n1400000000", "\n1403636579").replace("1400000000", "1403636579", 1))
        lines = [line.split(" ", 1)[1] for line in file.read_text().splitlines()]
        write_text(file, [f"{1403636579763555584 + 50_000_000 * i}.0 {lines[i]}" for i in (0, 2, 5)])
    expected = [filmed.views[i] for i in ((0, 2, 5) if kind == "orbslam3" else range(2))]
    frames = delivered(tmp_path / "a", kind, number, *(() if kind == "orbslam3" else ("source.stop=2",)))
    for frame, view in zip(frames, expected, strict=True):
        np.testing.assert_allclose(frame.T_camera_world, view.T_camera_world, atol=1e-6)
        assert len(frame.points) > 20 or kind in ("replica", "matrices", "tanksandtemples")


@pytest.mark.parametrize("kind", SHARED_DATA)
def test_the_example_reads_a_real_recording(shared_data, tmp_path, kind):
    name = SHARED_DATA[kind]
    (tmp_path / name).symlink_to(shared_data("tum_fr1_desk" if kind == "tum" else name))
    frames = delivered(tmp_path, kind, 0, f"source.stop={40 if kind == 'stella_vslam' else 2}")
    assert len(frames) == (14 if kind == "stella_vslam" else 2)  # frame 0 and those from 27 on


@pytest.mark.parametrize("kind", CAPTURES)
def test_the_example_reads_a_capture(filmed, tmp_path, kind):
    path = load_example(tmp_path, kind).source.path
    assert path is not None
    WRITERS[kind](tmp_path / "unpacked", filmed.views[:2])
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix:
        zipped(tmp_path / "unpacked", path)
    else:
        (tmp_path / "unpacked").rename(path)
    frames = delivered(tmp_path, kind, 0, "source.step=1")
    for frame, view in zip(frames, filmed.views[:2], strict=True):
        np.testing.assert_allclose(frame.T_camera_world, view.T_camera_world, atol=1e-6)


@pytest.mark.parametrize("number", [0, 1])
def test_the_example_reads_a_bag(filmed, tmp_path, number):
    write_bag(tmp_path / "corridor.bag", "ros1", bag_messages(filmed.views[:2], "ros1"))
    for frame, view in zip(delivered(tmp_path, "bag", number), filmed.views[:2], strict=True):
        np.testing.assert_allclose(frame.T_camera_world, view.T_camera_world, atol=1e-9)


def delivered(root: Path, kind: str, number: int = 0, *overrides: str) -> list:
    """All frames of the example, run in this folder."""
    (root / "scene.yaml").write_text(blocks()[kind][number])
    return list(open_tracker(load_scene(root / "scene.yaml", overrides)))


def load_example(root: Path, kind: str) -> SceneConfig:
    file = root / "scene.yaml"
    file.write_text(blocks()[kind][0])
    return load_scene(file)
