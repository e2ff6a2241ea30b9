"""An output folder that is, holds or lies in what a scene reads is refused; ordinary scenes are not."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.config.scene_paths import refuse_output_in_input
from modp_ti.files.errors import InputError
from modp_ti.files.run_folder import appearing
from modp_ti.inputs.opening import open_source
from tests.modp_ti.runs import check, run

COLMAP = (
    "source: {path: images, masks: masks, vignette: extra/v.png, ground_truth: extra/gt.txt}\ntracker: {kind: colmap"
)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A folder with all that the scenes below name."""
    for name in ("images", "masks", "sparse/0", "colmap/sparse/0", "extra", "capture/rgb", "out/first", "poses"):
        (tmp_path / "scene" / name).mkdir(parents=True)
    for name in ("images/1.png", "images/2.png", "masks/1.png", "extra/v.png", "capture/rgb/1.png", "poses/1.png"):
        cv2.imwrite(str(tmp_path / "scene" / name), np.full((4, 4), 255, np.uint8))
    for name in ("sparse/0/cameras.bin", "capture/rgb.txt", "film.mp4", "extra/gt.txt", "out/first/config.yaml"):
        (tmp_path / "scene" / name).touch()
    (tmp_path / "scene" / "link").symlink_to("images")
    (tmp_path / "scene" / "twice").symlink_to(tmp_path / "scene", target_is_directory=True)
    return tmp_path / "scene"


def refuse(folder: Path, text: str) -> None:
    (folder / "scene.yaml").write_text(text)
    refuse_output_in_input(load_scene(folder / "scene.yaml"), folder)


FILM = "source: {path: film.mp4}\ntracker: {kind: klt}"
BARE = "source: {path: images}\ntracker: {kind: %s}"


@pytest.mark.parametrize(
    ("text", "output"),
    [
        *((COLMAP + "}", output) for output in (".", "images", "images/..", "link", "twice", "twice/images", "masks")),
        *((COLMAP + "}", output) for output in ("..", "/", "extra", "out/../images", "images/out", "masks/deep/out")),
        *((COLMAP + "}", output) for output in ("sparse", "sparse/0")),  # where `colmap` looks
        (COLMAP + ", path: colmap/sparse/0}", "colmap"),
        (COLMAP + ", path: colmap/sparse/0}", "colmap/sparse/0"),
        (BARE % "sevenscenes", "poses"),
        (FILM, "."),
        (FILM, "film.mp4"),
        (FILM + "\nonto: out/first", "out/first"),
        (FILM + "\nonto: out/first", "out"),
        (FILM + "\nonto: out/first", "out/first/second"),
        (FILM + "\nevaluation: {lpips_weights: extra}", "extra"),
        (FILM + "\nmapping: {depth: {checkpoint: extra/v.png}}", "extra"),
        ("source: {path: film.mp4}\ntracker: {kind: tum, path: extra/gt.txt, points: poses/1.png}", "poses"),
        ("source: {path: capture, kind: tum_rgbd}\ntracker: {kind: klt}", "capture/rgb"),
        ("source: {path: capture, kind: tum_rgbd}\ntracker: {kind: klt}", "capture"),
        ("source: {path: .}\ntracker: {kind: klt}", "images"),
        ("source: {path: .}\ntracker: {kind: klt}", "."),
    ],
)
def test_an_output_in_the_input_is_refused(scene: Path, text: str, output: str) -> None:
    before = sorted(scene.parent.rglob("*"))
    with pytest.raises(InputError) as refused:
        refuse(scene, f"{text}\noutput: {output}\n")
    assert "\n" not in str(refused.value)
    assert sorted(scene.parent.rglob("*")) == sorted([*before, scene / "scene.yaml"])


@pytest.mark.parametrize(
    ("text", "output"),
    [
        *((COLMAP + "}", output) for output in ("out", "out/fox", "../out", "images2", "images/../new", "twice/out/a")),
        (BARE % "colmap, path: .", "out/new"),
        (BARE % "transforms, path: .", "new"),
        (BARE % "socket, path: out/socket", "out"),
        (FILM, "film"),
        (FILM + "\nonto: out/first", "out/second"),
        ("source: {path: capture, kind: tum_rgbd}\ntracker: {kind: klt}", "capture/out"),
        ("source: {path: .}\ntracker: {kind: klt}", "out/new"),
    ],
)
def test_an_output_of_its_own_is_not(scene: Path, text: str, output: str) -> None:
    refuse(scene, f"{text}\noutput: {output}\n")


def test_images_of_a_run_in_the_folder_of_the_images_are_no_input(scene: Path) -> None:
    text = "source: {path: .}\ntracker: {kind: klt}\noutput: out/new\n"
    refuse(scene, text)
    config = load_scene(scene / "scene.yaml")
    before = open_source(config.source).names
    with appearing(scene / "out" / "new") as folder:
        (folder / "renders").mkdir()
        cv2.imwrite(str(folder / "renders" / "000000.png"), np.zeros((4, 4, 3), np.uint8))
    refuse(scene, text)
    assert open_source(config.source).names == before


def written(folder: Path) -> dict[Path, tuple[int, int]]:
    return {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in folder.rglob("*")}


@pytest.mark.slow
def test_run_and_check_say_so_before_anything_is_read_or_written(scene: Path) -> None:
    (scene / "scene.yaml").write_text(f"{COLMAP}}}\noutput: .\n")
    before = written(scene.parent)
    for command in (run, check):
        said = command(scene / "scene.yaml", "--quiet")
        assert said.returncode == 2 and "output" in said.stdout + said.stderr
        assert written(scene.parent) == before
    assert os.listdir(scene.parent) == ["scene"]
