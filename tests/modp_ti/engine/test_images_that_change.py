"""Images that disappear, change or heal after they were mapped: the other frames are scored as they were mapped."""

from __future__ import annotations

import csv
import io
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from modp_ti.config.scene_file import load_scene
from modp_ti.engine import session, stages
from modp_ti.engine.stream import Observer
from modp_ti.files.errors import InputError
from tests.fault_injection.recordings import write_recording

FRAMES, PLACE = 12, 3
KEEP = ["export.images=true", "source.prefetch=2"]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    write_recording(folder, FRAMES, 0.25, 2, 0)
    session.run_scene(load_scene(folder / "scene.yaml", KEEP))
    return folder


class Meddler(Observer):
    """Does something to the images when the map is saved."""

    def __init__(self, meddle: Callable[[], object]) -> None:
        self._meddle = meddle

    def on_stage(self, stage: str) -> None:
        self._meddle()


def scores(out: Path) -> dict[str, tuple[str, float]]:
    with (out / "scores.csv").open() as file:
        return {row["name"]: (row["index"], float(row["psnr"])) for row in csv.DictReader(file)}


def others(image: np.ndarray) -> dict[str, Callable[[Path], object]]:
    return {
        "gone": Path.unlink,
        "cut off": lambda file: file.write_bytes(file.read_bytes()[:500]),
        "another picture": lambda file: cv2.imwrite(str(file), 255 - image),
        "another size": lambda file: cv2.imwrite(str(file), image[:-8]),
    }


@pytest.mark.parametrize("what", ["gone", "cut off", "another picture", "another size"])
def test_the_other_frames_keep_their_scores_and_pictures(
    what: str, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "meddled"
    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("out"))
    name = f"{PLACE:06d}.png"
    file = folder / "images" / name
    meddle = others(np.asarray(cv2.imread(str(file))))[what]
    monkeypatch.setattr(stages, "open_observer", lambda *_: Meddler(lambda: meddle(file)))
    said = io.StringIO()
    session.run_scene(load_scene(folder / "scene.yaml", KEEP), Console(file=said, width=1000))
    expected = scores(recording / "out")
    assert expected.pop(name)[0] == str(PLACE)
    assert scores(folder / "out") == expected
    notes = [line for line in said.getvalue().splitlines() if name in line]
    assert len(notes) == 1, notes
    for each in expected:
        images = [place / "out" / "colmap" / "images" / each for place in (folder, recording)]
        assert images[0].read_bytes() == images[1].read_bytes()
    assert not (folder / "out" / "colmap" / "images" / name).exists()


def test_an_image_that_heals_was_not_mapped_and_is_not_scored(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = []
    for heals in (False, True):
        folder = tmp_path / str(heals)
        shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("out"))
        file = folder / "images" / f"{PLACE:06d}.png"
        whole = file.read_bytes()
        file.write_bytes(whole[:500])
        meddler = Meddler(lambda file=file, whole=whole, heals=heals: heals and file.write_bytes(whole))
        monkeypatch.setattr(stages, "open_observer", lambda *_, meddler=meddler: meddler)
        session.run_scene(load_scene(folder / "scene.yaml", KEEP))
        results.append(scores(folder / "out"))
    assert results[0] == results[1] and len(results[0]) == FRAMES - 1


def test_without_any_image_there_are_no_scores_but_the_map(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "lost"
    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("out"))
    monkeypatch.setattr(stages, "open_observer", lambda *_: Meddler(lambda: shutil.rmtree(folder / "images")))
    with pytest.raises(InputError, match="without its scores"):
        session.run_scene(load_scene(folder / "scene.yaml", KEEP))
    assert (folder / "out" / "splats.ply").read_bytes() == (recording / "out" / "splats.ply").read_bytes()
