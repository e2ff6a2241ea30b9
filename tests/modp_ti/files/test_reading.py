"""A file costs no more than it has, what is no file is refused before one waits for it, and errors are one line."""

from __future__ import annotations

import os
import sys
import zipfile
from pathlib import Path

import pytest

from modp_ti.files import input_lines, open_file, parse_json, read_bytes, reading
from modp_ti.files.errors import InputError
from modp_ti.files.file_tree import open_tree
from modp_ti.files.reading import available_memory
from modp_ti.files.yaml_text import parse_yaml


def test_pipes_devices_and_folders_are_no_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path, tmp_path / "none"):
        with pytest.raises(OSError) as caught:
            read_bytes(path)
        assert caught.value.strerror
    with pytest.raises(InputError), reading(tmp_path):
        read_bytes(tmp_path / "a\0b")


def test_a_file_beyond_the_memory_is_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_bytes(b"x" * 5000)
    module = sys.modules["modp_ti.files.reading"]
    monkeypatch.setattr(module, "available_memory", lambda: 4 * 5000)
    assert read_bytes(tmp_path / "file") == b"x" * 5000
    monkeypatch.setattr(module, "available_memory", lambda: 4 * 5000 - 1)
    with pytest.raises(OSError):
        read_bytes(tmp_path / "file")
    with open_file(tmp_path / "file") as file:
        assert file.read(2) == b"xx"


def test_lines_have_an_end(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("one\ntwo\nthree")
    assert list(input_lines(tmp_path / "file")) == ["one\n", "two\n", "three"]
    lines = input_lines(tmp_path / "file", longest=4)
    assert [next(lines), next(lines)] == ["one\n", "two\n"]
    with pytest.raises(InputError):
        next(lines)


def test_some_memory_is_available_and_no_more_than_there_is() -> None:
    assert 1 << 20 < available_memory() <= os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[" * 100_000 + "]" * 100_000, 1),
        ('{"a": [1, 2}', 1),
        ('{"a":\n\n [1, 2', 3),
        ('{"a":\n "b\n', 2),
        ("[1,\n2 3]", 2),
    ],
)
def test_json_is_refused_with_its_line(text: str, line: int) -> None:
    with pytest.raises(InputError, match=rf"^text:{line}: ") as caught:
        parse_json(text, "text")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["a: &x [1]\nb: *x", "a: &x {k: 1}\nb:\n  <<: *x", "[" * 40 + "]" * 40, "- 1\n" * 30_000, "a: 1\na: 2", "a: .inf"],
)
def test_yaml_that_could_grow_is_refused(text: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_yaml(text, "file", {})
    assert str(refused.value).startswith("file:") and "\n" not in str(refused.value)


@pytest.mark.parametrize("form", ["folder", "zip", "zip of a folder"])
def test_folders_and_archives_list_the_same_files(tmp_path: Path, form: str) -> None:
    names = ["a.json", "b/1.png", "b/2.png", "b/c/3.png", ".hidden", "__MACOSX/a.json"]
    path = tmp_path / ("scene.zip" if form != "folder" else "scene")
    top = "top/" if form == "zip of a folder" else ""
    if form == "folder":
        for name in names:
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            (path / name).write_bytes(b"[1]")
    else:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name in names:
                archive.writestr(top + name, b"[1]")
    tree = next(tree for tree in open_tree(path) if tree.has("a.json"))
    assert tree.is_folder == (form == "folder")
    assert tree.listed() == ["a.json"] and tree.listed("b") == ["b/1.png", "b/2.png"] and tree.listed("none") == []
    assert tree.has("b/c/3.png") and not tree.has("b") and not tree.has("none")
    assert tree.read("b/1.png") == b"[1]" and tree.read_json("a.json") == [1]
    with pytest.raises(OSError):
        tree.read("none")
    tree.close()


def test_what_is_no_archive_or_unpacks_to_too_much_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.zip").write_bytes(b"text")
    with pytest.raises(InputError):
        open_tree(tmp_path / "text.zip")
    with zipfile.ZipFile(tmp_path / "large.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("zeros", bytes(30_000_000))
    with pytest.raises(OSError):
        open_tree(tmp_path / "large.zip")[0].read("zeros")


@pytest.mark.parametrize("error", [OverflowError("x"), IndexError(), MemoryError(), EOFError("two\nlines")])
def test_whatever_a_reader_raises_names_the_file(error: Exception) -> None:
    with pytest.raises(InputError, match=r"^file: "), reading("file"):
        raise error


def test_an_error_of_our_own_words_and_an_interruption_pass() -> None:
    for error in (InputError("plain words"), KeyboardInterrupt()):
        with pytest.raises(type(error), match=r"^plain words$|^$"), reading("file"):
            raise error
