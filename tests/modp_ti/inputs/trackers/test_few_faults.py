"""A few damaged images and lines in the midst of a recording are left out and counted; many are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from modp_ti.files.errors import InputError
from tests.opening import assert_poses, opened, refusal
from tests.samples.filmed import film
from tests.samples.kinds import write_sample

COUNT, FPS = 30, 30.0
FILMED = film(COUNT, (48, 36), [f"{i:04d}.png" for i in range(COUNT)])
NAMES = FILMED.names


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_sample("tum", tmp_path / "a", FILMED)
    return tmp_path / "a"


def damage(folder: Path, i: int, how: str = "cut off") -> None:
    file = folder / "images" / NAMES[i]
    data = bytearray(file.read_bytes())
    if how == "cut off":
        data = data[:-200]
    else:  # the compressed pixels, the headers being whole
        data[60:200] = bytes(140)
    file.write_bytes(data)


def change_line(folder: Path, i: int, line: str) -> None:
    lines = (folder / "trajectory.txt").read_text().splitlines()
    lines[i + 1] = line  # below the heading
    (folder / "trajectory.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("how", ["cut off", "spoilt within"])
def test_damaged_images_are_left_out_and_reported_once(folder: Path, how: str) -> None:
    damage(folder, 6, how)
    damage(folder, 8, how)
    tracker = opened(folder, "source.holdout=4")
    kept = [i for i in range(COUNT) if i not in (6, 8)]
    names = [NAMES[i] for i in kept]
    frames = list(tracker)
    assert [frame.name for frame in frames] == names
    assert [frame.index for frame in frames] == list(range(COUNT - 2))
    # The frames that are held out are the same ones as of a recording in order.
    assert [frame.name for frame in frames if frame.held_out] == [NAMES[i] for i in kept if i % 4 == 0]
    assert_poses(frames, [FILMED.views[i] for i in kept])
    assert [name for name, _ in tracker.pictures([*names, NAMES[6]])] == names
    said = [note for note in tracker.notes if "damaged" in note]
    assert len(said) == 1 and f"2 of {COUNT}" in said[0] and str(folder / "images" / NAMES[6]) in said[0]


def test_many_images_that_are_cut_off_are_refused_before_the_first_frame(folder: Path) -> None:
    for i in range(5, 9):
        damage(folder, i)
    assert f"{NAMES[5]}: unreadable image: the file is cut off" in refusal(folder)


def test_many_images_that_are_spoilt_within_end_the_run(folder: Path) -> None:
    for i in range(5, 9):
        damage(folder, i, "spoilt within")
    tracker = opened(folder)
    with pytest.raises(InputError, match=r"0005\.png: unreadable image"):
        list(tracker)


@pytest.mark.parametrize(
    "line",
    ["0.7 nan nan nan nan nan nan nan", "0.05 0 0 0 0 0 0 1", "9000 0 0 0 0 0 0 1", "0.6 0 0 inf 0 0 0 1"],
    ids=["nan", "back in time", "far ahead", "infinite"],
)
def test_a_line_that_is_no_pose_costs_its_frame_alone(folder: Path, line: str) -> None:
    change_line(folder, 7, line)
    tracker = opened(folder)
    assert [frame.name for frame in tracker] == [name for i, name in enumerate(NAMES) if i != 7]
    assert f"1 of {COUNT} lines of trajectory.txt hold NaN or a time out of order: left out" in tracker.notes
    assert_poses(tracker.frames, [view for i, view in enumerate(FILMED.views) if i != 7])


@pytest.mark.parametrize(
    ("line", "said"),
    [("{0} nan 0 0 0 0 0 1", "trajectory.txt:7: holds NaN"), ("0 0 0 0 0 0 0 1", "does not lie after")],
)
def test_many_such_lines_are_refused(folder: Path, line: str, said: str) -> None:
    for i in range(5, 9):
        change_line(folder, i, line.format(i / FPS))
    assert said in refusal(folder)
