"""`report.html`: one file that loads nothing, whose figures, curves and pictures are those of the run."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from fields.runtime.engine import engine
from modp_ti.engine.results import Results
from modp_ti.outputs.report.page import ReportedRun, write_report
from modp_ti.outputs.report.plots import frame_rate
from modp_ti.outputs.report.where_wrong import ErrorSurvey
from pipelines.render.renderer import RenderedView
from tests.modp_ti.outputs.report.made_up_run import Page, black_frame, delivered, made_up_run, picture

pytestmark = pytest.mark.slow

EVIL = "</td><script>alert('x')</script><img src=http://evil.example/a.png> & \"{{ 7 * 7 }}\""


def written(tmp_path, run: ReportedRun) -> tuple[Page, str]:
    file = tmp_path / "report.html"
    write_report(file, run)
    html = file.read_text(encoding="utf-8")
    return Page(html), html


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run, and its page as parsed and as text."""
    folder = tmp_path_factory.mktemp("page")
    run = made_up_run(folder)
    return run, *written(folder, run)


def assert_draws(points, notes, x: str, y: str):
    """A drawn curve is two attributes of the notes, but for the axes' scales: x to the right, y up."""
    assert len(points) == len(notes)
    for axis, name, sign in ((0, x, 1), (1, y, -1)):
        data = np.array([getattr(note, name) for note in notes], float)
        A = np.stack([data, np.ones(len(data))], axis=1)
        slope = np.linalg.lstsq(A, points[:, axis], rcond=None)[0]
        assert sign * slope[0] > 0 or np.ptp(data) == 0
        assert np.abs(A @ slope - points[:, axis]).max() < 0.01


def test_the_page_loads_nothing(made) -> None:
    _, page, html = made
    for tag, key, value in page.attributes:
        if (tag, key) == ("a", "href"):
            assert value == "map.html"  # followed only by a click
            continue
        assert key not in ("href", "srcset", "action", "background", "poster"), (tag, key)
        assert key != "src" or value.startswith("data:image/"), value[:60]
        assert not key.startswith("on")
    assert not set(page.tags) & {"script", "link", "iframe", "object", "embed", "base"}
    assert "url(" not in html and "@import" not in html and "default-src 'none'" in html
    for svg in page.embedded("curves", "svg+xml") + page.embedded("trajectory", "svg+xml"):
        hrefs = re.findall(r'(?:xlink:)?href="([^"]{0,20})', svg.decode())
        assert all(href.startswith(("#", "data:")) for href in hrefs)


def test_the_numbers_are_those_of_the_metrics(made) -> None:
    run, page, html = made
    rows = {row[0]: row[1:] for row in page.tables["numbers"] if row}
    for stage in ("online", "refined"):
        m = run.metrics[stage]
        expected = []
        for which in ("held_out", "fitted"):
            s = m[which]
            expected += [f"{s['psnr']:.2f}", f"{s['ssim']:.3f}", "–", f"{s['detail']:.2f}", str(s["count"])]
        assert rows[stage] == [*expected, f"{m['gaussians']:,}", f"{m['view_renders']:,}"]
    figures = [cell for row in rows.values() for cell in row]
    kept = run.metrics["retention"]["refined"]
    assert {"0.0123", "0.0345", "1,234 MB"} <= set(figures)
    assert any(f"{kept['mean']:+.2f} dB" in cell and f"{kept['worst']:+.2f} dB" in cell for cell in figures)
    headline = " ".join(page.text)
    for which in ("held_out", "fitted"):
        assert f"{run.metrics['refined'][which]['psnr']:.2f} dB" in headline
    assert f"{run.metrics['gaussians']:,}" in headline
    rows, seconds = {row[0]: row[1:] for row in page.tables["time"]}, run.metrics["seconds"]
    assert {name for name in rows if name != "total"} == {k for k, v in seconds.items() if v > 0 and k != "total"}
    assert all(row[1] == f"{seconds[name]:.1f} s" for name, row in rows.items())
    widths = [float(w) for w in re.findall(r'<i style="width: ([0-9.]+)%">', html)]
    assert sum(widths) == pytest.approx(100, abs=0.1), "bars as long as the stages"


def test_where_it_is_wrong_stands_in_tables_whose_shares_sum_to_one(made) -> None:
    run, page, _ = made
    assert run.survey.in_words() in page.text
    rows = {row[0]: row[1:] for row in page.tables["wrong"]}
    for bins in (run.survey.by_depth(), run.survey.by_angle()):
        shown = np.array([[float(cell.rstrip(" %")) for cell in rows[of.label][1:3]] for of in bins])
        np.testing.assert_allclose(shown, [[100 * of.pixels, 100 * of.error] for of in bins], atol=0.051)
        np.testing.assert_allclose(shown.sum(axis=0), 100, atol=0.05 * len(bins))
    assert len(page.embedded("wrong", "svg+xml")) == 1


def test_the_curves_are_the_recorded_numbers(made) -> None:
    run, page, _ = made
    curves, frames = page.curves(), run.record.frames
    assert_draws(curves["gaussians"][0], frames, "index", "gaussians")
    assert_draws(curves["view-psnr"][0], [note for note in frames if note.psnr is not None], "index", "psnr")
    assert_draws(curves["step-psnr"][0], run.record.steps, "step", "psnr")
    for stage in ("online", "refined"):
        assert_draws(curves[f"psnr-{stage}"][0], [s for s in run.scores if s.stage == stage], "index", "psnr")
    assert len(curves["frame-rate"][0]) == np.isfinite(frame_rate(frames, 5)).sum()
    # 1 and 2 % of a unit, and 1 and 2 degrees, at every frame; the depth is 2 units.
    for name in ("shift", "turn"):
        online, refined = (curves[f"{name}-{stage}"][0][:, 1] for stage in ("online", "refined"))
        assert np.ptp(online) < 0.01 and np.ptp(refined) < 0.01
        assert refined[0] < online[0]


def test_the_trajectory_is_seen_from_above_before_and_after(made) -> None:
    run, page, _ = made
    curves = page.curves()
    # World's z is up: what is drawn is a similarity of x and y, in both panels.
    for panel in range(2):
        drawn = np.concatenate([curves[f"way-{name}"][panel] for name in ("before", "after")])
        drawn[:, 1] *= -1
        ways = [run.tracked, run.versions["refined"].trajectory]
        ground = np.array([(-T[:3, :3].T @ T[:3, 3])[:2] for way in ways for T in way])
        a, b = (v - v.mean(axis=0) for v in (ground, drawn))
        U, s, Vt = np.linalg.svd(a.T @ b)
        assert np.linalg.det(U @ Vt) > 0, "seen from above, not from below"
        np.testing.assert_allclose(s.sum() / (a * a).sum() * a @ (U @ Vt), b, atol=0.1)


def test_pictures_settings_and_machine_are_those_of_the_run(made) -> None:
    run, page, _ = made
    assert len(page.embedded("pictures", "jpeg")) == 3 * 6
    held_out = sorted(s.psnr for s in run.scores if s.held_out and s.stage == "refined")
    captions = [line for line in page.text if re.search(r"frame \d+, frame", line)]
    assert [float(re.search(r"([0-9.]+) dB", line)[1]) for line in captions] == pytest.approx(held_out, abs=0.006)
    assert captions[0].startswith("worst: ") and captions[-1].startswith("best: ")
    assert {row[0]: row[1:] for row in page.tables["settings"][1:]} == {
        "source.scale": ["0.5", '"auto"'],
        "source.holdout": ["4", "empty"],
        "tracker.kind": ['"transforms"', "none"],
        "output": ['"out"', "none"],
        "source.path": ['"images"', "empty"],
    }
    made_with = {row[0]: row[1] for row in page.tables["machine"]}
    assert made_with["backend"] == "CPU" and str(engine()) in made_with["libraries"]


def test_text_from_files_is_text_and_no_markup(tmp_path) -> None:
    name = EVIL.replace("{", "{{").replace("}", "}}") + "{}"
    run = made_up_run(tmp_path, frames=5, refine=0, name=name, notes=(EVIL,))
    config = run.config.model_copy(update={"output": tmp_path / EVIL.replace("/", ":")})
    page, html = written(tmp_path, dataclasses.replace(run, config=config))
    assert "script" not in page.tags and "<script" not in html
    assert not [value for _, key, value in page.attributes if key == "src" and not value.startswith("data:image/")]
    assert sum(EVIL in line for line in page.text) >= 2
    assert "49" not in "".join(line for line in page.text if "script" in line), "the text is no template"


def test_folders_and_passwords_of_the_sender_are_left_out(tmp_path, monkeypatch) -> None:
    home = tmp_path / "sam doe"
    scene, elsewhere = home / "my fox", tmp_path / "elsewhere"
    scene.mkdir(parents=True)
    monkeypatch.setenv("HOME", str(home))
    notes = [
        f"no weights in {home}/.cache/torch/checkpoints (see evaluation.lpips_weights)",
        f"{scene}/images/a b.png: damaged; '{elsewhere}/masks/7.png' is missing",
        "topic /camera_left/image_raw at http://camera.local/live/1: 3/4 of it",
        "frames come from rtsp://user:secret@camera:554/live",
    ]
    run = made_up_run(scene, frames=5, refine=0, notes=tuple(notes))
    tracker = run.config.tracker.model_copy(update={"path": scene / "sparse/0/transforms.json"})
    config = run.config.model_copy(update={"tracker": tracker, "onto": elsewhere / "earlier"})
    page, html = written(tmp_path, dataclasses.replace(run, config=config))
    for folder in (tmp_path, home, scene):
        assert str(folder) not in html and folder.name not in html
    assert "secret" not in html and "rtsp://camera:554/live" in html
    shown = "\n".join(page.text)
    for kept in ("no weights in checkpoints (see", "images/a b.png: damaged; '7.png' is missing", notes[2]):
        assert kept in shown
    rows = {row[0]: row[1] for row in page.tables["settings"][1:]}
    assert (rows["tracker.path"], rows["onto"]) == ('"sparse/0/transforms.json"', '"earlier"')


def test_a_run_without_scores_and_one_with_gaps_have_their_pages(tmp_path, recwarn) -> None:
    run = made_up_run(tmp_path, frames=6, refine=0, holdout=0)
    scores = [dataclasses.replace(s, psnr=float("inf")) if s.index == 3 else s for s in run.scores]
    page, _ = written(tmp_path, dataclasses.replace(run, scores=scores))
    assert len(page.curves()["psnr-online"][0]) == 5, "what is not finite is a gap"
    run.record.frames[:] = [dataclasses.replace(note, mapped_psnr=None) for note in run.record.frames]
    state = {name: values[:0] for name, values in run.versions["online"].gaussians.items()}
    nothing = {"online": dataclasses.replace(run.versions["online"], gaussians=state)}
    bare = dataclasses.replace(run, scores=(), comparisons=(), versions=nothing, survey=ErrorSurvey(held_out=False))
    page, _ = written(tmp_path, bare)
    assert "wrong" not in page.tables
    assert "way-after" in page.curves() and not [str(w.message) for w in recwarn]


@pytest.mark.parametrize(
    ("changes", "there", "missing"),
    [
        ({"mode": "offline"}, {"step-psnr", "step-gaussians"}, {"gaussians", "shift-online"}),
        ({"holdout": 0, "refine": 0}, {"gaussians"}, {"step-psnr"}),
        ({"frames": 1, "holdout": 0, "refine": 0, "truth": False}, {"way-after"}, {"way-truth"}),
        ({"frames": 300, "holdout": 15, "refine": 5000, "size": (480, 640)}, {"step-psnr"}, set()),
    ],
)
def test_every_kind_of_run_has_its_page_of_limited_size(tmp_path, changes, there, missing, recwarn, caplog) -> None:
    page, html = written(tmp_path, made_up_run(tmp_path, **changes))
    curves = set(page.curves())
    assert there <= curves and not missing & curves
    assert not [str(w.message) for w in recwarn] + caplog.messages, "drawing warns of nothing"
    assert len(html) < 3_000_000


def test_a_report_that_fails_costs_a_note_and_not_the_map(tmp_path) -> None:
    run = made_up_run(tmp_path, frames=6, refine=0, holdout=0)
    results = Results(run.config, delivered(list(run.tracked), [False] * 6))
    with results.writing_map():
        (results.folder / "splats.ply").touch()
    for scores, versions in ((list(run.scores), dict(run.versions)), ([], {})):
        with results.writing_figures():
            for i in range(6):
                frame = dataclasses.replace(black_frame(i), image=picture(i, (16, 16)))
                flat = np.ones((16, 16), np.float32)
                results.write_frame(frame, RenderedView(picture(i + 1, (16, 16)), flat, flat), None)
            said = results.write_report(run.record, dict(run.metrics), scores, versions, (), 2.0, [])
        if versions:
            page = Page((run.config.output / "report.html").read_text(encoding="utf-8"))
            assert said is None and len(page.embedded("pictures", "jpeg")) == 3 * 6
        else:
            assert "report.html" in said and "\n" not in said


def test_a_realtime_run_shows_lag_and_steps_over_time(tmp_path) -> None:
    run = made_up_run(tmp_path)
    run.record.frames[:] = [
        dataclasses.replace(note, lag=0.01 * note.index, waiting=note.index % 5, steps=3 + note.index % 4)
        for note in run.record.frames
    ]
    live = dict.fromkeys(("keyframes_merged", "keyframes_skipped", "seconds_to_map", "rate_arrived", "rate_tracked"), 2)
    live |= {"arrived": 1200, "tracked": 24, "thinned": 1170, "lost": 6, "further_steps": 17}
    live |= {"steps_per_keyframe": 4.25, "lag_seconds": {"median": 0.31, "p95": 0.9, "max": 1.25}}
    page, html = written(tmp_path, dataclasses.replace(run, metrics={**run.metrics, "live": live}))
    curves, frames = page.curves(), run.record.frames
    assert_draws(curves["lag"][0], frames, "done", "lag")
    assert_draws(curves["waiting"][0], frames, "done", "waiting")
    assert_draws(curves["keyframe-steps"][0], [note for note in frames if note.is_keyframe], "done", "steps")
    for shown in ("0.31 s", "0.90 s", "1.25 s", "1,170", "4.2"):
        assert shown in html
