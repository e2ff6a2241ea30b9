"""The examples of docs/sources.md: each is a valid scene file, and opens the data that its section describes."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from modp_ti.config.scene_file import load_scene
from modp_ti.inputs.opening import open_source, recognised_kind
from modp_ti.inputs.readers import SOURCES
from modp_ti.inputs.source_settings import SourceSettings

PAGE = Path(__file__).resolve().parents[4] / "docs" / "sources.md"
EXAMPLES = dict(re.findall(r"^## ([^\n]+)\n\n```yaml\n(.*?)```", PAGE.read_text(), re.DOTALL | re.MULTILINE))


def image(file: Path, width: int, height: int) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(file), np.full((height, width, 3), 90, np.uint8))


def video(file: Path) -> None:
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"mp4v"), 30, (64, 48))
    for _ in range(13):
        writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()


# What lies beside the scene file, and the name and size of an image that it then gives.
DATA = {
    "A folder of images": (lambda at: image(at / "images/frame2.jpg", 64, 48), "frame2.jpg", (64, 48)),
    "A video": (lambda at: video(at / "room.mp4"), "room_000012", (64, 48)),
    "A recording at its own pace": (lambda at: video(at / "room.mp4"), "room_000012", (64, 48)),
    "Panoramas: images that see all round": (
        lambda at: image(at / "panoramas/0001.png", 512, 256),
        "0001-face3.png",
        (194, 194),
    ),
    "Your own intrinsics": (lambda at: image(at / "images/a.png", 640, 480), "a.png", (640, 480)),
}
WITHOUT_DATA = {"A camera or a stream", "Project Aria recordings"}
# Sections whose source tells the camera; the others leave it to the tracker.
WITH_CAMERA = {
    "Panoramas: images that see all round",
    "Your own intrinsics",
}


def settings(example: str, folder: Path) -> SourceSettings:
    """`source:` of the example, as a scene file in the folder."""
    file = folder / "scene.yaml"
    file.write_text(EXAMPLES[example])
    block = yaml.safe_load(EXAMPLES[example])
    assert set(block) == {"source", "tracker", "output"}
    return load_scene(file).source


def test_every_section_with_an_example_is_tried():
    assert set(EXAMPLES) == set(DATA) | WITHOUT_DATA


@pytest.mark.parametrize("example", DATA)
def test_example_opens_what_its_section_describes(example, tmp_path):
    make, name, size = DATA[example]
    make(tmp_path)
    images = open_source(settings(example, tmp_path))
    assert name in images.names
    assert images.size(name) == size
    assert images.read(name).shape == (size[1], size[0], 3)
    assert (images.intrinsics is not None) == (example in WITH_CAMERA)


def test_examples_that_need_a_device_are_valid(tmp_path):
    live = settings("A camera or a stream", tmp_path)
    assert (live.stream, live.stop, live.path) == (0, 600, None)
    aria = settings("Project Aria recordings", tmp_path)
    assert recognised_kind(aria.path) == "vrs"
    assert aria.vrs == SourceSettings().vrs, "the page says that these are the defaults"


def test_table_names_every_kind_once():
    kinds = re.findall(r"^\| `(\w+)` \|", PAGE.read_text(), re.MULTILINE)
    assert sorted(kinds) == sorted(["images", "video", "live", *SOURCES])
