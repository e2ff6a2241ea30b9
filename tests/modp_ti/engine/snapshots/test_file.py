"""The file of a snapshot: what comes out is what went in; anything else is refused in one line."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from modp_ti.engine.snapshots import FILE, Snapshot
from modp_ti.engine.snapshots import snapshot as module
from modp_ti.engine.snapshots.snapshot import Position
from modp_ti.files.errors import InputError
from modp_ti.version import __version__

ARRAYS = {
    "gaussians.position": np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32),
    "voxels.words": np.array([1, 1 << 63], dtype=np.uint64),
    "frames.held_out": np.array([True, False]),
    "previous.index": np.array(7),
    "online.sh": np.zeros((0, 4, 3), dtype=np.float32),
}
NUMBERS = {"random": {"state": 2**127 + 5}, "rate": 0.1}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    Snapshot(tmp_path / FILE, {"seed": 3}, Position(7, 2**32 - 1, True, 9), ARRAYS, NUMBERS).write(tmp_path / FILE)
    return tmp_path / FILE


def assert_refused(file: Path, *said: str) -> None:
    with pytest.raises(InputError) as refused:
        Snapshot.read(file)
    assert all(text in str(refused.value) for text in (str(file), *said)) and "\n" not in str(refused.value)


def test_what_is_written_is_read_back_to_the_bit(path: Path) -> None:
    found = Snapshot.read(path)
    assert (found.settings, found.numbers, found.program) == ({"seed": 3}, NUMBERS, __version__)
    assert found.position == Position(7, 2**32 - 1, True, 9)
    assert list(found.arrays) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert found.arrays[name].dtype == array.dtype and found.arrays[name].shape == array.shape
        assert found.arrays[name].tobytes() == array.tobytes()
    found.arrays["gaussians.position"][0] = 1.0  # the run resumes in these arrays
    assert [p.name for p in path.parent.iterdir()] == [FILE]


@pytest.mark.parametrize("version", [5, "1", None])
def test_another_version_is_refused_with_its_number(path: Path, monkeypatch, version: object) -> None:
    monkeypatch.setattr(module, "VERSION", version)
    Snapshot(path, {}, Position(0, 0), ARRAYS, NUMBERS).write(path)
    monkeypatch.undo()
    assert_refused(path, f"{version}", f"{module.VERSION}", f"MODP-Ti {__version__}")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_one_cut_short_is_refused(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    assert_refused(path)


def test_a_flipped_bit_is_noticed_or_harmless(path: Path) -> None:
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(100):
        data = bytearray(whole)
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            arrays = Snapshot.read(path).arrays
        except InputError as error:
            assert "\n" not in str(error)
        else:  # names of files and times stand in the archive twice
            assert all(arrays[name].tobytes() == array.tobytes() for name, array in ARRAYS.items() if name in arrays)


def stored(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue()


def headed(shape: tuple[int, ...]) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return stream.getvalue()


@pytest.mark.parametrize(
    "member",
    [
        headed((1 << 40, 1 << 20)),  # huge
        headed((5,)),  # shorter than it says
        stored(np.array([{"a": 1}], dtype=object)),  # what Python would run
        *(stored(np.frombuffer(text, dtype=np.uint8)) for text in (b"", b"[]", b"{}", b"\xff", b"nonsense")),
    ],
)
def test_an_archive_that_is_none_of_ours_is_refused(tmp_path: Path, member: bytes) -> None:
    with zipfile.ZipFile(tmp_path / FILE, "w") as out:
        out.writestr("about.npy", member)
    assert_refused(tmp_path / FILE)
