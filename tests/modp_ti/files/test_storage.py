"""A storage by URL: files appear whole, what is missing is said, and every failure is one line."""

from __future__ import annotations

import uuid
from pathlib import Path

import pytest

from modp_ti.files.storage import Storage, StorageError


@pytest.fixture(params=["file", "memory"])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> Storage:
    place = f"file://{tmp_path}/a store" if request.param == "file" else f"memory://{uuid.uuid4().hex}/a store"
    return Storage(place)


def test_a_file_comes_back_as_it_was_and_the_latest_counts(storage: Storage, tmp_path: Path) -> None:
    file, back = tmp_path / "file", tmp_path / "back"
    assert not storage.has("deep/name") and not storage.get("deep/name", back) and not back.exists()
    for content in (b"first", b"second, and longer"):
        file.write_bytes(content)
        storage.put(file, "deep/name")
        assert storage.get("deep/name", back)
        assert back.read_bytes() == content
    assert Storage(storage.url).within("deep").has("name")
    storage.remove("deep/name")
    storage.remove("deep/name")
    assert not storage.has("deep/name")


def test_a_folder_comes_back_as_it_was(storage: Storage, tmp_path: Path) -> None:
    contents = {"metrics.json": b"{}", "a/b/c.bin": b"\0\1", "a/d e.txt": b"", "z": b"z"}
    for name, content in contents.items():
        (tmp_path / "from" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "from" / name).write_bytes(content)
    storage.put_folder(tmp_path / "from")
    (tmp_path / "to").mkdir()
    storage.get_folder(tmp_path / "to")
    files = [file for file in (tmp_path / "to").rglob("*") if file.is_file()]
    assert {file.relative_to(tmp_path / "to").as_posix(): file.read_bytes() for file in files} == contents


def test_what_was_there_stays_where_a_copy_fails(tmp_path: Path) -> None:
    storage = Storage(f"file://{tmp_path}/store")
    (tmp_path / "file").write_bytes(b"first")
    storage.put(tmp_path / "file", "name")
    with pytest.raises(StorageError, match=r"cannot be written: .*/gone \(FileNotFoundError\)"):
        storage.put(tmp_path / "gone", "name")
    assert (tmp_path / "store" / "name").read_bytes() == b"first"


@pytest.mark.parametrize("method", ["probe", "put", "put_folder"])
def test_failures_are_one_line(tmp_path: Path, method: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "metrics.json").touch()
    storage = Storage(f"file://{tmp_path}/file/store")
    arguments = {"probe": [], "put": [tmp_path / "file", "name"], "put_folder": [tmp_path / "folder"]}
    with pytest.raises(StorageError) as error:
        getattr(storage, method)(*arguments[method])
    assert str(error.value) == f"file://{tmp_path}/file/store: cannot be written: Not a directory"
