"""Whole runs of a small room, short, as a user starts them: in processes of their own."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from rich.console import Console

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from fields.runtime.engine import engine
from modp_ti.config.scene_file import load_scene
from modp_ti.engine import session, stages
from modp_ti.engine.mapper import build_mapper
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_tracker
from modp_ti.inputs.protocol import Tracker
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.outputs.evaluation import summary
from modp_ti.outputs.formats.run_files import read_scores
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.formats.trajectory import read_trajectory
from modp_ti.outputs.lpips import open_lpips
from tests.modp_ti.outputs.report.made_up_run import Page
from tests.modp_ti.runs import FILES

BESIDE = ["images", "scene.yaml", "sparse"]

pytestmark = pytest.mark.slow


@pytest.fixture
def scene(finished: Path, tmp_path: Path) -> Path:
    """The scene file of the finished run, beside the same images, in a folder of its own."""
    for name in ("images", "sparse"):
        (tmp_path / name).symlink_to(finished.parent / name)
    return Path(shutil.copy(finished.parent / "scene.yaml", tmp_path))


def test_a_run_leaves_all_its_files_and_nothing_half_written(finished: Path) -> None:
    assert sorted(p.name for p in finished.iterdir()) == FILES
    assert sorted(p.name for p in finished.parent.iterdir()) == sorted([*BESIDE, "out"])
    assert sorted(p.name for p in (finished / "renders").iterdir()) == ["000000.png", "000004.png", "000008.png"]


def test_the_metrics_say_what_happened(finished: Path) -> None:
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["frames"] == 9
    assert metrics["backend"] == "cpu"
    assert metrics["engine"] == str(engine())
    assert metrics["seed"] == 3
    assert 1 <= metrics["keyframes"] <= 6
    assert (
        metrics["gaussians"] == metrics["refined"]["gaussians"] == len(read_splats(finished / "splats.ply")["position"])
    )
    assert metrics["refined"]["gaussians"] <= metrics["online"]["gaussians"]
    # Once over the keyframes for what shows, then twenty steps of four views.
    assert metrics["refined"]["view_renders"] == metrics["online"]["view_renders"] + metrics["keyframes"] + 20 * 4
    assert metrics["online"]["all"]["count"] == metrics["refined"]["all"]["count"] == 9
    assert metrics["online"]["held_out"]["count"] == 3
    assert metrics["refined"]["held_out"]["psnr"] > metrics["online"]["held_out"]["psnr"]
    assert metrics["online"]["all"]["lpips"] is None
    assert metrics["lpips_note"].startswith("LPIPS is not computed: no alexnet-owt-7be5be79.pth")
    assert metrics["ate_rmse"] is metrics["ate_rmse_rigid"] is metrics["ate_rmse_tracked"] is None  # no ground truth
    seconds = metrics["seconds"]
    assert list(seconds) == [
        *("total", "compile", "read", "track", "select", "depth"),
        *("occupancy", "optimise", "refine", "evaluate", "other"),
    ]
    parts = sum(value for stage, value in seconds.items() if stage != "total")
    assert parts == pytest.approx(seconds["total"], abs=0.02)
    percent = metrics["breakdown_percent"]
    assert list(percent) == ["optimise", "select", "depth", "occupancy", "others"]
    assert sum(percent.values()) == pytest.approx(100.0, abs=0.05)
    assert min(percent.values()) >= 0
    online = 9 / metrics["frames_per_second"]
    # Seconds are rounded to 1 ms, percentages to 0.01.
    rounding = 0.01 + 100 * 0.0005 / online
    assert percent["optimise"] == pytest.approx(100 * seconds["optimise"] / online, abs=rounding)


def psnr_of_pictures(renders: Path) -> float:
    """Mean PSNR [dB] of side-by-side pictures, without what their 8 bits add to the error: 1/12 of a step squared."""
    errors = []
    for path in sorted(renders.iterdir()):
        frame, render = np.hsplit(cv2.imread(str(path)).astype(np.float64) / 255.0, 2)
        errors.append(-10 * np.log10(((frame - render) ** 2).mean() - 1 / (12 * 255**2)))
    return float(np.mean(errors))


def test_the_scores_are_those_of_the_pictures(finished: Path) -> None:
    held_out = json.loads((finished / "metrics.json").read_text())["refined"]["held_out"]
    assert held_out["psnr"] == pytest.approx(psnr_of_pictures(finished / "renders"), abs=0.02)


def test_the_report_shows_the_figures_and_the_pictures_of_the_run(finished: Path) -> None:
    page = Page((finished / "report.html").read_text(encoding="utf-8"))
    metrics = json.loads((finished / "metrics.json").read_text())
    rows = {row[0]: row[1:] for row in page.tables["numbers"] if row}
    for stage in ("online", "refined"):
        held_out, fitted = metrics[stage]["held_out"], metrics[stage]["fitted"]
        assert rows[stage][0] == f"{held_out['psnr']:.2f}" and rows[stage][5] == f"{fitted['psnr']:.2f}"
        assert rows[stage][3] == f"{held_out['detail']:.2f}" and rows[stage][8] == f"{fitted['detail']:.2f}"
    assert any("3 held-out frames, refined map" in line for line in page.text)
    times = {row[0]: row[2] for row in page.tables["time"]}
    assert times["total"] == f"{metrics['seconds']['total']:.1f} s"
    assert any(line.startswith("LPIPS is not computed: ") for line in page.text), "what the run remarked"
    assert ["tracker.kind", '"colmap"', "none"] in page.tables["settings"]
    growth = page.curves()["gaussians"][0]
    assert len(growth) == 9 and growth[0, 1] > growth[-1, 1], "the map grew"
    assert len(page.curves()["step-psnr"][0]) == 20

    pictures = [cv2.imdecode(np.frombuffer(data, np.uint8), 1) for data in page.embedded("pictures", "jpeg")]
    by_psnr = sorted(
        (score.psnr, score.index)
        for score in read_scores(finished / "scores.csv")
        if score.held_out and score.stage == "refined"
    )
    assert len(pictures) == 3 * len(by_psnr)
    for (_, index), frame, render in zip(by_psnr, pictures[::3], pictures[1::3], strict=True):
        pair = cv2.imread(str(finished / "renders" / f"{index:06d}.png")).astype(float)
        assert np.abs(np.hstack([frame, render]) - pair).mean() < 6, "as JPEG shows them"


def test_every_frame_has_its_scores_in_each_version_of_the_map(finished: Path) -> None:
    scores = read_scores(finished / "scores.csv")
    assert [(score.stage, score.index) for score in scores] == [
        (stage, index) for stage in ("online", "refined") for index in range(9)
    ]
    assert [score.held_out for score in scores] == [index % 4 == 0 for index in [*range(9), *range(9)]]
    assert len({score.name for score in scores}) == 9
    keyframes = json.loads((finished / "frames.json").read_text())["keyframes"]
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["views_between"] == 0
    for stage in ("online", "refined"):
        of = [score for score in scores if score.stage == stage]
        assert metrics[stage]["all"] == summary(of)
        assert metrics[stage]["held_out"] == summary([score for score in of if score.held_out])
        assert metrics[stage]["fitted"] == summary([score for score in of if score.index in keyframes])


def test_every_frame_has_its_pose(finished: Path) -> None:
    times, poses = read_trajectory(finished / "trajectory.txt")
    np.testing.assert_allclose(times, np.arange(9) / 10)
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (9, 1, 1)), atol=1e-9)


def test_the_colmap_model_has_every_frame_at_its_refined_pose(finished: Path) -> None:
    model = pycolmap.Reconstruction(str(finished / "colmap"))
    tracked = list(open_tracker(load_scene(finished / "config.yaml")))
    refined = read_trajectory(finished / "trajectory.txt")[1]
    assert [model.images[i + 1].name for i in range(9)] == [frame.name for frame in tracked]
    for i, (frame, T) in enumerate(zip(tracked, refined, strict=True)):
        np.testing.assert_allclose(model.images[i + 1].cam_from_world().matrix(), T[:3], atol=1e-12)
        pixels = [p.xy for p in model.images[i + 1].get_observation_points2D()]
        np.testing.assert_array_equal(pixels, frame.points.pixels.astype(np.float32))
    assert len(model.points3D) == len({i for frame in tracked for i in frame.points.ids.tolist()})
    metrics = json.loads((finished / "metrics.json").read_text())
    # The recording's pixels are off by 0.3 of a pixel, its points by 2 % of their depth.
    assert 0.2 < metrics["reprojection_error_tracked"] < 2.0
    assert 0.2 < metrics["reprojection_error"] < 2.0
    assert metrics["reprojection_error"] != metrics["reprojection_error_tracked"]
    # Without the points' own error what is left is the pixels'.
    for name in ("", "_tracked"):
        assert 0.1 < metrics[f"reprojection_error_anew{name}"] < metrics[f"reprojection_error{name}"]


@pytest.fixture(scope="module")
def again(finished: Path, lpips_weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of a second run, from the configuration that the first one wrote, and with LPIPS."""
    output = tmp_path_factory.mktemp("again") / "out"
    overrides = [f"output={output}", f"evaluation.lpips_weights={lpips_weights}", "export.report=false"]
    return session.run_scene(load_scene(finished / "config.yaml", overrides))


def test_the_written_configuration_gives_the_same_map_byte_for_byte(finished: Path, again: Path) -> None:
    assert load_scene(finished / "config.yaml").source.scale == 1.0, "what auto became"
    for name in ("splats.ply", "trajectory.txt"):
        assert (again / name).read_bytes() == (finished / name).read_bytes()


def test_a_run_that_asks_for_no_report_leaves_none(again: Path) -> None:
    assert sorted(p.name for p in again.iterdir()) == [name for name in FILES if name != "report.html"]


def test_lpips_is_that_of_the_pictures(again: Path, lpips_weights: Path) -> None:
    lpips, _ = open_lpips(lpips_weights, 100)
    distances = []
    for path in sorted((again / "renders").iterdir()):
        pair = cv2.imread(str(path))[..., ::-1].astype(np.float32) / 255
        distances.append(lpips(*np.hsplit(pair, 2)))
    metrics = json.loads((again / "metrics.json").read_text())
    # The pictures have 8 bits: at most 0.9 % of the mean and 1.8 % of a frame in four draws.
    assert metrics["lpips_note"] is None
    assert metrics["refined"]["held_out"]["lpips"] == pytest.approx(np.mean(distances), rel=0.03)
    scores = {s.index: s.lpips for s in read_scores(again / "scores.csv") if s.stage == "refined" and s.held_out}
    assert list(scores.values()) == pytest.approx(distances, rel=0.05)


@pytest.mark.parametrize("override", ["source.start=900", "mapping.keyframes.min_points=100000"])
def test_a_scene_that_cannot_be_mapped_is_refused_in_one_line_and_writes_nothing(scene: Path, override: str) -> None:
    with pytest.raises(InputError, match=r"^[^\n]+$"):
        session.run_scene(load_scene(scene, [override]))
    assert sorted(p.name for p in scene.parent.iterdir()) == BESIDE


class LiveTracker(Tracker):
    """Two black frames, a note that only their end brings, and something to let go of."""

    def __init__(self):
        self.said = ["said first"]
        self.closed = False

    @property
    def notes(self):
        return self.said

    def __iter__(self):
        camera = PinholeCamera(60.0, 60.0, 32.0, 24.0, 64, 48)
        for i in range(2):
            yield TrackedFrame(i, i / 30, str(i), np.zeros((48, 64, 3), np.float32), camera, np.eye(4))
        self.said.append("said last")

    def pictures(self, names):
        return iter(())

    def close(self):
        self.closed = True


def test_a_tracker_is_closed_and_heard_to_its_end_however_the_run_ends(scene, monkeypatch):
    config = load_scene(scene)
    tracker = LiveTracker()
    monkeypatch.setattr(stages, "open_tracker", lambda *_: tracker)
    said = io.StringIO()
    with pytest.raises(InputError, match="no frame became a keyframe"):
        session.run_scene(config, Console(file=said, width=200))
    assert tracker.closed
    notes = [line for line in said.getvalue().splitlines() if line.startswith("note: said")]
    assert notes == ["note: said first", "note: said last"]


def test_a_realtime_run_makes_a_larger_mapper_for_images_larger_than_expected(scene, monkeypatch):
    sides = []

    def noted(config, camera, pace):
        sides.append(camera.width)
        return build_mapper(config, camera, pace)

    monkeypatch.setattr(stages, "EXPECTED", PinholeCamera(1.0, 1.0, 8.0, 8.0, 16, 16))
    monkeypatch.setattr(ReplayedTracker, "largest", (0, 0))  # a live tracker does not know
    monkeypatch.setattr(stages, "build_mapper", noted)
    short = ["mapping.pace=realtime", "source.stop=3", "refine.steps=0", "export.report=false"]
    output = session.run_scene(load_scene(scene, short))
    assert sides == [16, 80]
    metrics = json.loads((output / "metrics.json").read_text())
    assert metrics["frames"] == 3 and metrics["seconds"]["track"] >= 0
