from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modp_ti.files.errors import InputError
from modp_ti.outputs.formats.keyframe_masks import read_masks, write_masks


def test_masks_are_read_as_they_were_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    masks = {place: rng.integers(0, 256, (9, 12), dtype=np.uint8) for place in (0, 7, 1_000_000)}
    write_masks(tmp_path / "masks", masks)
    found = read_masks(tmp_path / "masks")
    assert list(found) == list(masks)
    for place, mask in masks.items():
        np.testing.assert_array_equal(found[place], mask)


def test_a_run_without_masks_has_none(tmp_path: Path) -> None:
    assert read_masks(tmp_path / "masks") == {}


@pytest.mark.parametrize(
    ("name", "content"),
    [("000003.png", b"\x89PNG\r\n\x1a\n cut off"), ("000003.png", b""), ("first.png", None), ("000004.png", "colour")],
)
def test_damaged_masks_are_refused(tmp_path: Path, name: str, content: bytes | str | None) -> None:
    folder = tmp_path / "masks"
    shape = (9, 12, 3) if content == "colour" else (9, 12)
    write_masks(folder, {3: np.zeros(shape, dtype=np.uint8)})
    data = (folder / "000003.png").read_bytes()
    (folder / "000003.png").unlink()
    (folder / name).write_bytes(content if isinstance(content, bytes) else data)
    with pytest.raises(InputError, match=rf"{name}: no mask of a run"):
        read_masks(folder)
