"""Inputs of the readers: the real data where it is there, a posed scene with known geometry, and made LPIPS weights."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from tests.modp_ti.runs import SHORT_RUN, finished_run
from tests.samples.filmed import film
from tests.samples.trackers import write_images

if TYPE_CHECKING:
    from tests.room import RoomRecording


@dataclass(frozen=True)
class PlaneScene:
    """Photographs of a textured plane z = 0 of the world, written as PNG files.

    K: (3, 3), pixel centres at +0.5. T_camera_world: (N, 4, 4), OpenCV axes. size: (width, height).
    """

    folder: Path
    names: list[str]
    K: NDArray[np.float64]
    T_camera_world: NDArray[np.float64]
    size: tuple[int, int]

    def write_transforms(self, **changes: object) -> Path:
        """transforms.json beside the image folder; `changes` replace or (None) remove its keys."""
        flip = np.diag([1.0, -1.0, -1.0, 1.0])
        data: dict[str, object] = {
            "fl_x": self.K[0, 0],
            "fl_y": self.K[1, 1],
            "cx": self.K[0, 2],
            "cy": self.K[1, 2],
            "w": self.size[0],
            "h": self.size[1],
            "frames": [
                {"file_path": f"images/{name}", "transform_matrix": (np.linalg.inv(T) @ flip).tolist()}
                for name, T in zip(self.names, self.T_camera_world, strict=True)
            ],
        }
        data.update(changes)
        file = self.folder.parent / "transforms.json"
        file.write_text(json.dumps({key: value for key, value in data.items() if value is not None}))
        return file

    def write_colmap(self, points: NDArray[np.float64], text: bool = False) -> Path:
        """A COLMAP model in sparse/0 in which every image observes every point that it sees."""
        from tests.room import write_colmap

        seen, pixels = [], []
        for T in self.T_camera_world:
            p = points @ T[:3, :3].T + T[:3, 3]
            uv = ((p / p[:, 2:]) @ self.K.T)[:, :2]
            visible = (p[:, 2] > 0) & (uv > 0).all(axis=1) & (uv < self.size).all(axis=1)
            seen.append(np.flatnonzero(visible))
            pixels.append(uv[visible])
        folder = self.folder.parent / "sparse" / "0"
        folder.mkdir(parents=True, exist_ok=True)
        camera = PinholeCamera(self.K[0, 0], self.K[1, 1], self.K[0, 2], self.K[1, 2], *self.size)
        write_colmap(folder, camera, self.names, list(self.T_camera_world), points, seen, pixels, text)
        return folder


@pytest.fixture
def plane_scene(tmp_path: Path) -> PlaneScene:
    """Seven views, 320x240, of a plane with blobs of many sizes, from an arc of 25 degrees at distance 4."""
    filmed = film(7, (320, 240), [f"view{i}.png" for i in range(8, 15)])  # not in the order of the alphabet
    write_images(tmp_path, filmed)
    poses = np.stack([view.T_camera_world for view in filmed.views])
    return PlaneScene(tmp_path / "images", list(filmed.names), filmed.K, poses, filmed.size)


@pytest.fixture(scope="session")
def lpips_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with LPIPS weights that nobody has trained, in files as torchvision and the `lpips` package bring them."""
    shapes = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3), 10: (256, 256, 3, 3)}
    generator = torch.Generator().manual_seed(2)
    alexnet = {"classifier.1.weight": torch.zeros(3, 3), "classifier.1.bias": torch.zeros(3)}
    linear = {}
    for n, (i, shape) in enumerate(shapes.items()):
        fan = shape[1] * shape[2] * shape[3]
        alexnet[f"features.{i}.weight"] = torch.randn(shape, generator=generator) * (2 / fan) ** 0.5
        alexnet[f"features.{i}.bias"] = 0.1 * torch.randn(shape[0], generator=generator)
        linear[f"lin{n}.model.1.weight"] = torch.rand(1, shape[0], 1, 1, generator=generator)
    folder = tmp_path_factory.mktemp("weights")
    torch.save(alexnet, folder / "alexnet-owt-7be5be79.pth")
    torch.save(linear, folder / "alex.pth", _use_new_zipfile_serialization=False)  # the package's is of the old format
    return folder


@pytest.fixture(scope="session")
def finished(made_once: Callable[[str, Callable[[Path], None]], Path], room_recording: RoomRecording) -> Path:
    """The output folder of one short run of the room, beside its scene.yaml and images. Not to be written to."""

    def fill(folder: Path) -> None:
        room_recording.write(folder)
        finished_run(folder, SHORT_RUN, "device: CPU")

    return made_once(SHORT_RUN, fill) / "out"


@pytest.fixture(scope="module")
def without_warm_up():
    """Runs in this process compile kernels as they come, which takes a fifth less. A warm-up changes no map."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pipelines.online.warm_up", lambda _: None)
        yield


@pytest.fixture
def interruptible():
    """Signals as in a shell's foreground: in the background, Ctrl-C may be ignored, and under nohup SIGHUP is."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler), signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGINT, before[0])
    signal.signal(signal.SIGHUP, before[1])
