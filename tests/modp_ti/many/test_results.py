"""The tables of a batch: what one writes, an independent reader finds; and the page links to the reports."""

from __future__ import annotations

import csv
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

from modp_ti.many.results import COLUMNS, SceneResult, State, figures, write_csv, write_parquet, write_summary_page

METRICS = {
    "frames": 9,
    "keyframes": 4,
    "gaussians": 1234,
    "frames_per_second": 2.5,
    "peak_memory_mb": 600.0,
    "ate_rmse": None,
    "online": {"all": {"count": 9}, "held_out": {"count": 3}},
    "refined": {
        "all": {"psnr": 31.0, "ssim": 0.9, "lpips": None, "detail": 0.5, "count": 9},
        "held_out": {"psnr": 30.0, "ssim": 0.8, "lpips": 0.25, "detail": 0.4, "count": 3},
    },
    "offline": None,
    "seconds": {"total": 125.0},
    "snapshots": {"resumed": 1},
}


def results(folder: Path) -> list[SceneResult]:
    return [
        SceneResult("a", "a.yaml", str(folder / "a b"), State.finished, 2, "host", figures=figures(METRICS)),
        SceneResult("<i>b</i>", "b.yaml", None, State.failed, error='a "quoted", <b>long</b> line'),
        SceneResult("c", "c.yaml", str(folder / "c"), State.waiting),
    ]


def test_figures_are_those_of_held_out_frames_or_else_of_all(tmp_path: Path) -> None:
    found = figures(METRICS)
    assert (found["scored"], found["psnr"], found["lpips"], found["seconds"]) == ("held_out", 30.0, 0.25, 125.0)
    nothing_held_out = METRICS | {"refined": METRICS["refined"] | {"held_out": {"count": 0}}}
    assert (figures(nothing_held_out)["scored"], figures(nothing_held_out)["psnr"]) == ("all", 31.0)
    assert set(found) < set(COLUMNS)


def test_the_table_is_read_back_as_it_was(tmp_path: Path) -> None:
    write_csv(tmp_path / "batch.csv", results(tmp_path))
    with (tmp_path / "batch.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    expected = [{name: "" if v is None else str(v) for name, v in r.row.items()} for r in results(tmp_path)]
    assert rows == expected
    assert rows[1]["error"] == 'a "quoted", <b>long</b> line' and rows[0]["state"] == "finished"


def test_parquet_has_the_same_table_with_types_that_do_not_depend_on_the_values(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    assert write_parquet(tmp_path / "all.parquet", results(tmp_path))
    assert write_parquet(tmp_path / "none.parquet", results(tmp_path)[1:])
    read = parquet.read_table(tmp_path / "all.parquet")
    assert read.to_pylist() == [result.row for result in results(tmp_path)]
    assert read.schema == parquet.read_table(tmp_path / "none.parquet").schema


def test_without_pyarrow_there_is_no_parquet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert not write_parquet(tmp_path / "all.parquet", results(tmp_path))
    assert list(tmp_path.iterdir()) == []


class Links(HTMLParser):
    """Collects the links and the text of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [value or "" for name, value in attrs if name in ("href", "src")]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_links_to_reports_shows_errors_and_loads_nothing(tmp_path: Path) -> None:
    (tmp_path / "a b").mkdir()
    (tmp_path / "a b" / "report.html").touch()
    page = tmp_path / "batch" / "index.html"
    page.parent.mkdir()
    write_summary_page(page, results(tmp_path))
    read = Links(page.read_text())
    assert read.links == ["../a%20b/report.html"]
    (tmp_path / "a b" / "report.html").unlink()
    write_summary_page(page, results(tmp_path))
    assert Links(page.read_text()).links == ["../a%20b"], "the folder, where there is no report"
    assert 'a "quoted", <b>long</b> line' in read.text and "<i>b</i>" in read.text
    assert "30.00" in read.text and "1,234" in read.text and "2 min" in read.text
    assert "font-variant-numeric" in page.read_text(), "the style of the reports"
    assert not re.search(r"{[{%]", page.read_text())
