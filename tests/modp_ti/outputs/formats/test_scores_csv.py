from __future__ import annotations

from pathlib import Path

import pytest

from modp_ti.files.errors import InputError
from modp_ti.outputs.evaluation import FrameScore
from modp_ti.outputs.formats.scores_csv import read_scores, write_scores

SCORES = [
    FrameScore(0, 'images/a, "b".png', True, "online", 1 / 3, 0.1 + 0.2, None, 2 / 3),
    FrameScore(11, "ü.png", False, "refined", 30.5, 1.0, 1e-7),
]


def test_scores_come_back_exactly(tmp_path: Path) -> None:
    write_scores(tmp_path / "scores.csv", SCORES)
    assert read_scores(tmp_path / "scores.csv") == SCORES


def test_the_columns_are_named(tmp_path: Path) -> None:
    write_scores(tmp_path / "scores.csv", SCORES[1:])
    assert (tmp_path / "scores.csv").read_text(encoding="utf-8").splitlines() == [
        "index,name,held_out,stage,psnr,ssim,lpips,detail",
        "11,ü.png,0,refined,30.5,1.0,1e-07,",
    ]


@pytest.mark.parametrize(
    "line", ["1,a,0,online,30", "1,a,0,online,30,0.5,", "1,a,0,online,x,0.5,,", "1,a,yes,online,30,0.5,,"]
)
def test_a_bad_line_is_named_with_its_number(tmp_path: Path, line: str) -> None:
    write_scores(tmp_path / "scores.csv", SCORES[1:])
    with (tmp_path / "scores.csv").open("a") as file:
        file.write(line + "\n")
    with pytest.raises(InputError, match=r"scores\.csv:3: "):
        read_scores(tmp_path / "scores.csv")


def test_files_of_the_first_version_have_no_detail(tmp_path: Path) -> None:
    (tmp_path / "scores.csv").write_text("index,name,held_out,stage,psnr,ssim,lpips\n3,a,1,online,30.5,0.9,\n")
    assert read_scores(tmp_path / "scores.csv") == [FrameScore(3, "a", True, "online", 30.5, 0.9, None, None)]


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        read_scores(tmp_path / "scores.csv")
    (tmp_path / "scores.csv").write_text("a,b\n")
    with pytest.raises(InputError, match=r"scores\.csv:1: the columns must be index,name"):
        read_scores(tmp_path / "scores.csv")
