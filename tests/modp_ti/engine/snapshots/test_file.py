"""The file of a snapshot: what comes out is what went in; anything else is refused in one line, and cheaply."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from modp_ti.engine.snapshots import file as snapshot_file
from modp_ti.engine.snapshots.file import FILE, VERSION, read_arrays, write_arrays
from modp_ti.files.errors import InputError
from modp_ti.version import __version__

ARRAYS = {
    "gaussians.position": np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32),
    "voxels.words": np.array([1, 1 << 63], dtype=np.uint64),
    "frames.held_out": np.array([True, False]),
    "previous.index": np.array(7),
    "online.sh": np.zeros((0, 4, 3), dtype=np.float32),
}
ABOUT = {"settings": {"seed": 3}, "random": {"state": 2**127 + 5}, "rate": 0.1}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_arrays(tmp_path / FILE, ARRAYS, ABOUT)
    return tmp_path / FILE


def test_what_is_written_is_read_back_to_the_bit(path: Path) -> None:
    arrays, about = read_arrays(path)
    assert about == {"version": VERSION, "program": __version__, **ABOUT}
    assert list(arrays) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype and arrays[name].shape == array.shape
        assert arrays[name].tobytes() == array.tobytes()
    arrays["gaussians.position"][0] = 1.0  # they may be gone on with
    assert [p.name for p in path.parent.iterdir()] == [FILE]


def test_it_is_an_archive_that_numpy_reads_without_pickle(path: Path) -> None:
    with np.load(path, allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["gaussians.position"], ARRAYS["gaussians.position"])
        assert json.loads(bytes(archive["about"]))["version"] == VERSION


@pytest.mark.parametrize("version", [0, VERSION + 1, "1", None])
def test_another_version_is_refused_with_its_number(tmp_path: Path, monkeypatch, version: object) -> None:
    monkeypatch.setattr(snapshot_file, "VERSION", version)
    write_arrays(tmp_path / FILE, ARRAYS, ABOUT)
    monkeypatch.undo()
    with pytest.raises(InputError) as refused:
        read_arrays(tmp_path / FILE)
    said = str(refused.value)
    assert "\n" not in said and all(text in said for text in (f"{version}", f"{VERSION}", f"MODP-Ti {__version__}"))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_one_cut_short_is_refused(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match="not a snapshot, or a damaged one"):
        read_arrays(path)


@pytest.mark.parametrize("seed", range(20))
def test_a_flipped_bit_is_noticed_or_harmless(path: Path, seed: int) -> None:
    data = bytearray(path.read_bytes())
    rng = np.random.default_rng(seed)
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)
    try:
        arrays, _ = read_arrays(path)
    except InputError as error:
        assert "\n" not in str(error)
    else:  # names of files and times stand in the archive twice
        assert all(arrays[name].tobytes() == array.tobytes() for name, array in ARRAYS.items() if name in arrays)


def archive(path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", compression) as out:
        for name, data in members.items():
            out.writestr(name, data)


def header(shape: tuple[int, ...], kind: str = "<f4", data: bytes = b"") -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": kind, "fortran_order": False, "shape": shape})
    return stream.getvalue() + data


def test_an_array_that_says_it_is_huge_is_refused_before_it_is_made(tmp_path: Path) -> None:
    archive(tmp_path / FILE, {"a.npy": header((1 << 40, 1 << 20))})
    with pytest.raises(InputError, match=r"a\.npy does not have the announced length"):
        read_arrays(tmp_path / FILE)


def test_an_archive_that_unpacks_to_more_than_itself_is_refused(tmp_path: Path) -> None:
    archive(tmp_path / FILE, {"a.npy": header((1 << 22,), data=bytes(1 << 24))}, zipfile.ZIP_DEFLATED)
    with pytest.raises(InputError, match="is compressed, or longer than the file"):
        read_arrays(tmp_path / FILE)


def test_what_python_would_run_is_refused(tmp_path: Path) -> None:
    stream = io.BytesIO()
    np.save(stream, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    archive(tmp_path / FILE, {"a.npy": stream.getvalue()})
    with pytest.raises(InputError, match="not plain numbers"):
        read_arrays(tmp_path / FILE)


@pytest.mark.parametrize("about", [b"", b"[]", b"{}", b"\xff", b"nonsense"])
def test_json_that_is_none_of_ours_is_refused(tmp_path: Path, about: bytes) -> None:
    archive(tmp_path / FILE, {"about.npy": header((len(about),), "|u1", about)})
    with pytest.raises(InputError, match="not a snapshot, or a damaged one"):
        read_arrays(tmp_path / FILE)
