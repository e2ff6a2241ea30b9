"""Quality against time: the points of a run, the frontier between them, and the comparison of two commits."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import quality
import versions
from quality import Point, frontier, points_of, psnr_at, seconds_to

from modp_ti.files.errors import InputError


def point(seconds: float, psnr: float, stage: str = "online", steps: int = 1) -> Point:
    return Point(steps, stage, seconds, psnr, 0.9, 0.8, psnr + 1, None, 1000, 5000)


def test_processor_time_is_divided_as_the_stages_of_the_run(make_metrics: Callable[..., dict]) -> None:
    # 100 s in all, of which 10 compile, 5 evaluate and 30 refine.
    online, refined = points_of(make_metrics(20.0, refined=21.0), processor=200.0, steps=4)
    assert (online.stage, online.seconds, online.psnr, online.view_renders) == ("online", 110.0, 20.0, 1000)
    assert (refined.stage, refined.seconds, refined.psnr, refined.steps) == ("refined", 170.0, 21.0, 4)
    assert [p.stage for p in points_of(make_metrics(20.0), 200.0, 4)] == ["online"]


def test_the_frontier_leaves_out_what_another_point_beats() -> None:
    points = [point(40.0, 24.0), point(10.0, 20.0), point(20.0, 19.0), point(80.0, 24.0)]
    assert frontier(points) == ([10.0, 40.0], [20.0, 24.0])


def test_quality_and_time_are_read_off_the_same_curve() -> None:
    points = [point(10.0, 20.0), point(40.0, 24.0)]
    assert psnr_at(points, 9.0) is None
    assert psnr_at(points, 20.0) == pytest.approx(22.0)  # halfway in the logarithm of time
    assert psnr_at(points, 1000.0) == 24.0
    assert seconds_to(points, 22.0) == pytest.approx(20.0)
    assert seconds_to(points, 24.5) is None


def test_programs_run_interleaved_and_the_median_of_their_time_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[str] = []
    speeds = {"new": iter([30.0, 10.0, 20.0]), "old": iter([60.0] * 3)}

    def measured(root: Path, scene: Path, steps: int, settings: dict) -> list[Point]:
        started.append(root.name)
        return [point(next(speeds[root.name]), 20.0 + steps, steps=steps)]

    monkeypatch.setattr(quality, "measured", measured)
    curves = quality.curves({"room": Path("scene.yaml")}, {"a+": Path("new"), "b": Path("old")}, [4], 3, {})
    assert started == ["new", "old", "old", "new", "new", "old"]
    assert [(p.seconds, p.psnr) for p in curves["room"]["a+"]] == [(20.0, 24.0)]


def test_the_report_compares_the_programs_at_the_same_quality() -> None:
    curves = {
        "room": {
            "new": [point(10.0, 20.0), point(40.0, 24.0), point(60.0, 25.0, "refined")],
            "old": [point(40.0, 22.0), point(90.0, 26.0, "refined")],
        }
    }
    text = quality.report(curves)
    assert "| room, online, 1 steps | 22.00 | 40 | 20 | 50 |" in text
    assert "| room, refined, 1 steps | 26.00 | 90 | – | – |" in text
    # The refined map of `new` is best after a minute; that of `old` has not come yet.
    assert "| room, new | 23.17 | 25.00 |" in text
    assert "| room, old | – | 24.00 |" in text


def test_another_commit_is_checked_out_and_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*arguments: str) -> None:
        who = ["-c", "user.name=a", "-c", "user.email=a@example.com"]
        subprocess.run(["git", "-C", str(tmp_path), *who, *arguments], check=True, capture_output=True)

    git("init")
    for text in ("first", "second"):
        (tmp_path / "file.py").write_text(text)
        git("add", ".")
        git("commit", "-m", text)
    monkeypatch.setattr(versions, "ROOT", tmp_path)
    commit = versions.this_version()
    assert not commit.endswith("+")
    (tmp_path / "file.py").write_text("third")
    assert versions.this_version() == commit + "+"
    with versions.checked_out("HEAD~1") as (_, other):
        assert (other / "file.py").read_text() == "first"
    assert not other.exists()
    with pytest.raises(InputError, match="no such revision"), versions.checked_out("nowhere"):
        pass


def test_the_table_of_a_given_time_has_the_last_map_of_each_run_and_how_late_it_was() -> None:
    runs = {"room": {0.5: {"psnr": 20.0, "seconds": 29.0}, 3.0: {"psnr": 25.5, "seconds": 180.4}}}
    text = quality.timed_report(runs | {"hall": {3.0: {"psnr": 22.25, "seconds": 170.0}}})
    assert "| scene | 0.5 min | 3 min |" in text and "+0.4 s" in text
    assert "| room | 20.00 | 25.50 |" in text and "| hall | – | 22.25 |" in text
