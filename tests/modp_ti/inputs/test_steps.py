"""Which images are photographs: the near views of a walk are a sequence, whatever else is in the folder is not."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from modp_ti.inputs import steps
from modp_ti.inputs.sources.image_folder import ImageFolder
from modp_ti.inputs.steps import why_photographs
from tests.room import Room, RoomRecording, look_at, pinhole, walk

CAMERA = pinhole(240, 180)
VIEWS = 12


@pytest.fixture(scope="module")
def near(room: Room, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Files of a walk through the room."""
    return written(tmp_path_factory.mktemp("near"), RoomRecording(room, CAMERA, walk(VIEWS, step=0.1)).images)


@pytest.fixture(scope="module")
def far(room: Room, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Files of views all round, 50 degrees apart."""
    eye = np.array([0.0, -0.6, 1.3])
    angles = np.radians(50) * np.arange(VIEWS)
    poses = [look_at(eye, eye + np.array([np.cos(angle), np.sin(angle), -0.2])) for angle in angles]
    return written(tmp_path_factory.mktemp("far"), RoomRecording(room, CAMERA, poses).images)


def written(folder: Path, images: list) -> list[Path]:
    files = [folder / f"{i:02d}.png" for i in range(len(images))]
    for file, image in zip(files, images, strict=True):
        cv2.imwrite(str(file), image[..., ::-1])
    return files


def test_near_views_are_a_sequence_and_far_ones_are_not(near: list[Path], far: list[Path]) -> None:
    assert why_photographs(near) is None and why_photographs(near[::-1]) is None
    assert why_photographs(far) is not None


def test_a_sequence_with_a_gap_stays_one(near: list[Path], far: list[Path]) -> None:
    assert why_photographs([*near[:6], far[0], *near[6:]]) is None


def test_images_of_several_sizes_are_photographs(near: list[Path], tmp_path: Path) -> None:
    image = cv2.imread(str(near[3]))
    assert image is not None
    for name, other in (("small.png", image[:170]), ("turned.png", image.swapaxes(0, 1))):
        cv2.imwrite(str(tmp_path / name), other)
        assert why_photographs([*near[:3], tmp_path / name, *near[3:]]) is not None


@pytest.mark.parametrize(
    ("images", "photographs"),
    [
        ("clips/street", True),
        ("courthouse/images", True),  # sfm places 285 of 286, klt 239
        ("university/images", False),  # klt places 324 of 324
        ("redkitchen/images", False),
        ("desk/images", False),
        ("fox/images", False),
    ],
)
def test_recordings_go_to_the_tracker_that_places_more(shared_data, images: str, photographs: bool) -> None:
    folder = ImageFolder(shared_data(images))
    assert (why_photographs([folder.path / name for name in folder.names]) is not None) == photographs


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_a_few_images_are_a_sequence(far: list[Path], count: int) -> None:
    assert why_photographs(far[:count]) is None


def test_what_cannot_be_compared_says_nothing(far: list[Path], tmp_path: Path) -> None:
    """Damaged files, missing ones, and images without texture."""
    (tmp_path / "damaged.png").write_bytes(far[0].read_bytes()[:300])
    cv2.imwrite(str(tmp_path / "white.png"), np.full((180, 240, 3), 255, np.uint8))
    assert why_photographs([tmp_path / name for name in ("damaged.png", "white.png", "none.png")] * 8) is None


def test_the_time_does_not_grow_with_the_number_of_images(far: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Path] = []
    monkeypatch.setattr(steps, "open_file", lambda path: opened.append(path) or open(path, "rb"))
    assert why_photographs(far * 100) is not None
    assert len(opened) <= 24
