from __future__ import annotations

from pathlib import Path

import pytest
import torch

from pipelines.torch_checkpoint import read_checkpoint, require_entries


class Harmful:
    """Unpickling this runs a command."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (type(self.target).touch, (self.target,))


def test_pickled_code_is_not_run(tmp_path: Path) -> None:
    path, target = tmp_path / "harmful.pth", tmp_path / "touched"
    torch.save({"weight": torch.zeros(2), "more": Harmful(target)}, path)
    with pytest.raises(ValueError, match="cannot be loaded as weights only") as caught:
        read_checkpoint(path)
    assert "\n" not in str(caught.value)
    assert not target.exists()
    torch.load(path, weights_only=False)
    assert target.exists()  # it would have


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([torch.zeros(1)], "holds list, not tensors by name"),
        ({"epoch": 3, "weight": torch.zeros(1)}, "entry `epoch` is int, not a tensor"),
        ({"weight": torch.tensor([torch.inf])}, "entry `weight` holds NaN or infinite"),
    ],
)
def test_anything_but_finite_tensors_by_name_is_refused(tmp_path: Path, content: object, said: str) -> None:
    torch.save(content, tmp_path / "w.pth")
    with pytest.raises(ValueError, match=said):
        read_checkpoint(tmp_path / "w.pth")


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such file"):
        read_checkpoint(tmp_path / "w.pth")
    (tmp_path / "w.pth").write_bytes(b"not a file of torch")
    with pytest.raises(ValueError, match=r"w\.pth: cannot be loaded"):
        read_checkpoint(tmp_path / "w.pth")
    torch.save({"model": {}}, tmp_path / "w.pth")
    with pytest.raises(ValueError, match="has no entry `state_dict`"):
        read_checkpoint(tmp_path / "w.pth", "state_dict")


def test_entries_come_as_float32_in_either_of_torch_s_formats(tmp_path: Path) -> None:
    for zipped in (True, False):
        path = tmp_path / f"{zipped}.pth"
        torch.save({"w": torch.arange(4, dtype=torch.float64)}, path, _use_new_zipfile_serialization=zipped)
        torch.testing.assert_close(read_checkpoint(path)["w"], torch.arange(4, dtype=torch.float32))


def test_the_first_wrong_entry_is_named(tmp_path: Path) -> None:
    entries = {"a": torch.zeros(2, 3), "b": torch.zeros(4)}
    require_entries(tmp_path, entries, {"a": (2, 3), "b": (4,)})
    with pytest.raises(ValueError, match="`c` is missing"):
        require_entries(tmp_path, entries, {"a": (2, 3), "c": (4,)})
    with pytest.raises(ValueError, match=r"`a` has shape \(2, 3\), it must have \(3, 2\)"):
        require_entries(tmp_path, entries, {"a": (3, 2), "b": (4,)})
    with pytest.raises(ValueError, match="`b` is unexpected"):
        require_entries(tmp_path, entries, {"a": (2, 3)})
