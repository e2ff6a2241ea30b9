"""Time stamps are associated as the TUM benchmark's tools describe it, and so are frames with their true poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Before
from modp_ti.inputs.timed_poses import TimedPoses, associate, open_ground_truth, true_poses


def by_hand(a, b, max_difference):
    """All pairs within reach, sorted by difference, taken while both are free."""
    pairs = sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) <= max_difference)
    taken = []
    for _, i, j in pairs:
        if all(i != p and j != q for p, q in taken):
            taken.append((i, j))
    return sorted(taken)


@pytest.mark.parametrize("reach", [0.004, 0.02, 0.3, 5.0])
@pytest.mark.parametrize("count", [0, 1, 60])
def test_pairs_are_the_nearest_first_one_to_one_within_reach(reach, count):
    rng = np.random.default_rng(3)
    a, b = np.cumsum(rng.uniform(0, 0.05, count)), rng.permutation(np.cumsum(rng.uniform(0, 0.04, 80)))
    found = associate(1305031452 + a, 1305031452 + b, reach)
    assert found.dtype == np.int64 and found.shape[1] == 2
    assert [tuple(pair) for pair in found] == by_hand(1305031452 + a, 1305031452 + b, reach)


def test_a_time_that_is_no_number_is_refused():
    with pytest.raises(ValueError, match="finite"):
        associate([np.nan], [1.0])


@pytest.fixture
def truth(tmp_path: Path) -> TimedPoses:
    path = tmp_path / "truth.txt"
    path.write_text("".join(f"{i / 10} {i} {i * i} 0 0 0 0 1\n" for i in range(6)))
    found = open_ground_truth(path)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("times", "before", "expected", "without"),
    [
        ([0.0, 0.101, 0.25, 0.3, 0.5], None, [0, 1, np.nan, 3, 5], 1),
        ([0.0, 1.0, 2.0], None, [], 2),  # fewer than three: no errors
        ([0.0, 0.1, 10.1, 10.2, 10.4], Before(frames=2, shift=10.0), [np.nan, np.nan, 1, 2, 4], 0),
    ],
)
def test_frames_get_the_true_pose_of_their_time(truth, times, before, expected, without):
    """Frames of an earlier map have none, and the others that of their own time."""
    poses, note = true_poses(truth, times, before)
    assert [-pose[0, 3] for pose in poses] == pytest.approx(expected, nan_ok=True)
    assert note is None if not without else note is not None and note.startswith(f"{without} of")


def test_a_missing_file_is_one_line(tmp_path: Path) -> None:
    assert open_ground_truth(None) is None
    with pytest.raises(InputError, match=r"source\.ground_truth"):
        open_ground_truth(tmp_path / "none.txt")
