"""Images that disappear, change or heal after they were mapped: the other frames are scored as they were mapped."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from modp_ti.config.scene_file import load_scene
from modp_ti.engine import session, stages
from modp_ti.files.errors import InputError
from tests.fault_injection.recordings import write_recording
from tests.modp_ti.engine.stopped_runs import Stopper

FRAMES = 12
# The last frame is held out, and so changes no map.
KEEP = ["export.images=true", "source.prefetch=2", "source.holdout=11"]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    write_recording(folder, FRAMES, 0.25, 2, 0)
    session.run_scene(load_scene(folder / "scene.yaml", KEEP))
    return folder


def scores(out: Path) -> dict[str, tuple[str, float]]:
    with (out / "scores.csv").open() as file:
        return {row["name"]: (row["index"], float(row["psnr"])) for row in csv.DictReader(file)}


def test_the_other_frames_keep_their_scores_and_pictures(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four images are damaged after they were mapped; a fifth was damaged before, and heals."""
    folder = tmp_path / "meddled"
    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("out"))
    names = [f"{place:06d}.png" for place in (3, 5, 6, 8, 11)]
    gone, cut, inverted, smaller, healing = (folder / "images" / name for name in names)
    image, whole = np.asarray(cv2.imread(str(inverted))), healing.read_bytes()
    healing.write_bytes(whole[:500])

    def meddle() -> None:
        gone.unlink()
        cut.write_bytes(cut.read_bytes()[:500])
        cv2.imwrite(str(inverted), 255 - image)
        cv2.imwrite(str(smaller), image[:-8])
        healing.write_bytes(whole)

    monkeypatch.setattr(stages, "open_observer", lambda *_: Stopper("evaluating the saved map", 1, meddle))
    session.run_scene(load_scene(folder / "scene.yaml", KEEP))
    expected = scores(recording / "out")
    for name in names:
        del expected[name]
        assert not (folder / "out" / "colmap" / "images" / name).exists()
    assert scores(folder / "out") == expected
    for each in expected:
        images = [place / "out" / "colmap" / "images" / each for place in (folder, recording)]
        assert images[0].read_bytes() == images[1].read_bytes()


def test_without_any_image_there_are_no_scores_but_the_map(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "lost"
    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("out"))
    monkeypatch.setattr(
        stages,
        "open_observer",
        lambda *_: Stopper("evaluating the saved map", 1, lambda: shutil.rmtree(folder / "images")),
    )
    with pytest.raises(InputError, match="without its scores"):
        session.run_scene(load_scene(folder / "scene.yaml", KEEP))
    assert (folder / "out" / "splats.ply").read_bytes() == (recording / "out" / "splats.ply").read_bytes()
