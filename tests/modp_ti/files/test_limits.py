"""Small files stay small: what archives, arrays and YAML claim is held against their bytes."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest

from modp_ti.files.errors import InputError
from modp_ti.files.limits import BoundedZip, array_of, arrays_of, most_unpacked
from modp_ti.files.reading import reading
from modp_ti.files.yaml_text import parse_yaml

ZEROS = bytes(30_000_000)


def archive(content: bytes = b"0123456789" * 50, packing: int = zipfile.ZIP_DEFLATED, name: str = "a") -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as written:
        written.writestr(zipfile.ZipInfo(name), content, compress_type=packing)
    return stream.getvalue()


def stating(size: int, data: bytes) -> bytes:
    """The archive with another unpacked size of its member in both of its headers."""
    for mark, at in ((b"PK\3\4", 22), (b"PK\1\2", 24)):
        place = data.index(mark) + at
        data = data[:place] + struct.pack("<I", size) + data[place + 4 :]
    return data


@pytest.mark.parametrize("packing", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_stored_and_deflated_members_are_read(packing: int) -> None:
    assert BoundedZip(archive(packing=packing)).read("a") == b"0123456789" * 50
    assert BoundedZip(archive(b"", packing)).read("a") == b""


@pytest.mark.parametrize(
    "data",
    [
        archive(ZEROS, zipfile.ZIP_BZIP2),
        archive(ZEROS, zipfile.ZIP_LZMA),
        archive(ZEROS),
        stating(1000, archive(ZEROS)),  # `zipfile` unpacks all of it before it looks at the size
        stating(1000, archive(ZEROS, zipfile.ZIP_BZIP2)),
        stating(1000, archive(bytes(100))),
        archive()[:-30],
        b"",
    ],
)
def test_no_member_unpacks_to_more_than_its_bytes_are_worth(data: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(zipfile.BadZipFile):
            BoundedZip(data).read("a")
        assert tracemalloc.get_traced_memory()[1] < most_unpacked(len(data))
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("data", [archive(), archive(archive(ZEROS))])
def test_an_archive_of_arrays_holds_stored_members_only(data: bytes) -> None:
    with pytest.raises(zipfile.BadZipFile):
        BoundedZip(data, stored=True)


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((3, 0, 2)),
        np.arange(12, dtype=">i2").reshape(3, 4),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.array(7.5),
        np.array([True, False]),
        np.array("name"),
    ],
)
def test_arrays_as_numpy_writes_them_are_read(array: np.ndarray) -> None:
    stream = io.BytesIO()
    np.savez(stream, a=array)
    found = arrays_of(BoundedZip(stream.getvalue(), stored=True), "biufU")["a"]
    np.testing.assert_array_equal(found, array)
    assert found.dtype == array.dtype and found.flags.writeable


def written(array: np.ndarray, before: bytes = b"", after: bytes = b"") -> bytes:
    stream = io.BytesIO()
    np.save(stream, array, allow_pickle=True)
    return stream.getvalue().replace(before, after)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        written(np.zeros(4))[:-1],
        written(np.zeros(4), b"(4,)", b"(9" + b"9" * 10 + b",)"),
        written(np.zeros(4), b"(4,)", b"(4,'"),
        written(np.zeros(4), b"'<f8'", b"'<z9'"),
        written(np.zeros(4), b"False", b"open('x')"),
        written(np.array([{}], dtype=object)),
        written(np.zeros(4, "S3")),
    ],
)
def test_other_arrays_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError):
        array_of(data)


@pytest.mark.parametrize(
    "text",
    ["a: &x [1]\nb: *x", "a: &x {k: 1}\nb:\n  <<: *x", "[" * 40 + "]" * 40, "- 1\n" * 30_000, "a: 1\na: 2", "a: .inf"],
)
def test_yaml_that_could_grow_is_refused(text: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_yaml(text, "file", {})
    assert str(refused.value).startswith("file:") and "\n" not in str(refused.value)


@pytest.mark.parametrize("error", [OverflowError("x"), IndexError(), MemoryError(), EOFError("two\nlines")])
def test_whatever_a_reader_raises_names_the_file(error: Exception) -> None:
    with pytest.raises(InputError, match=r"^file: "), reading("file"):
        raise error


def test_an_error_of_our_own_words_and_an_interruption_pass() -> None:
    for error in (InputError("plain words"), KeyboardInterrupt()):
        with pytest.raises(type(error), match=r"^plain words$|^$"), reading("file"):
            raise error
