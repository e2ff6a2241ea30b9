"""The map of a bag is that of the same images, poses and points in files, byte for byte."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fields.runtime.backend import initialise
from modp_ti.config.settings import SceneConfig
from modp_ti.engine.mapper import Mapper
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.protocol import Tracker
from pipelines.settings import MappingSettings
from tests.samples.bags import START, STEP, Messages, recording, write_bag

pytestmark = pytest.mark.slow
SETTINGS = MappingSettings.model_validate({"optimise": {"steps": 1}})
SCALE = 0.25
PLANE = np.stack(np.meshgrid(np.linspace(-2, 2, 40), np.linspace(-2, 2, 40), [0.0]), axis=-1).reshape(-1, 3)
CLOUD = PLANE.astype("<f4")


def tracker(source: dict, **settings: object) -> Tracker:
    config = {"source": {"scale": SCALE, "holdout": 4, **source}, "tracker": settings, "output": "out"}
    return open_tracker(SceneConfig.model_validate(config))


def digest(frames: Tracker, folder: Path) -> str:
    """Map the frames, and return the digest of the splats."""
    initialise("cpu")
    mapper = Mapper(80, 60, SETTINGS, seed=3)
    for frame in frames:
        mapper.add(frame)
    mapper.finish()
    mapper.save(folder)
    frames.close()
    return sha256((folder / "splats.ply").read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def of_files(views, tmp_path_factory, taichi_on_the_cpu) -> str:
    """The digest of the map of images, a trajectory and points in files."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "images").mkdir()
    lines = []
    for n, view in enumerate(views):
        cv2.imwrite(str(folder / f"images/{n}.png"), view.image)
        T = view.T_world_camera
        numbers = [n / 30, *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        lines.append(" ".join(repr(float(number)) for number in numbers))
    (folder / "trajectory.txt").write_text("\n".join(lines) + "\n")
    (folder / "points.txt").write_text("\n".join(" ".join(map(repr, map(float, xyz))) for xyz in CLOUD) + "\n")
    K = views[0].K
    camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    source = {"path": folder / "images", "intrinsics": camera}
    given = {"path": folder / "trajectory.txt", "points": folder / "points.txt"}
    return digest(tracker(source, kind="tum", **given), folder / "out")


def test_a_bag_gives_the_map_of_the_files(views, of_files, tmp_path):
    """The poses are those of the robot's body, to which two transforms lead; the cloud comes in four parts."""
    clouds = enumerate(np.split(CLOUD, 4))
    parts = [("/map", START + n * STEP, Messages("ros1").cloud(START + n, xyz)) for n, xyz in clouds]
    path = write_bag(tmp_path / "room.bag", "ros1", [*recording(views, "ros1"), *parts])
    assert digest(tracker({"path": path}, kind="bag"), tmp_path / "out") == of_files
