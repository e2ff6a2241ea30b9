"""What is no file is refused before one waits for it, and a file costs no more than it has."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from modp_ti.files import exists, is_file, open_file, parse_json, read_bytes, text_lines
from modp_ti.files import reading as files
from modp_ti.files.errors import InputError
from modp_ti.files.reading import available_memory


def failure(path: Path) -> str:
    with pytest.raises(OSError) as caught:
        read_bytes(path)
    return str(caught.value.strerror)


def test_pipes_devices_and_folders_are_no_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    assert failure(tmp_path / "pipe") == "it is a pipe, a socket or a device"
    assert failure(Path("/dev/zero")) == "it is a pipe, a socket or a device"
    assert failure(tmp_path) == "it is a folder"
    assert failure(tmp_path / "none") == "No such file or directory"
    assert failure(tmp_path / "a\0b") == "its name holds a NUL character"
    assert not is_file(tmp_path / "pipe") and not is_file(tmp_path / ("a" * 300)) and not exists(tmp_path / "a\0b")


def test_a_file_beyond_the_memory_is_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_bytes(b"x" * 5000)
    monkeypatch.setattr(files, "available_memory", lambda: 4 * 5000)
    assert read_bytes(tmp_path / "file") == b"x" * 5000
    monkeypatch.setattr(files, "available_memory", lambda: 4 * 5000 - 1)
    assert "too many for this machine's memory" in failure(tmp_path / "file")
    with open_file(tmp_path / "file") as file:
        assert file.read(2) == b"xx"


def test_lines_have_an_end(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("one\ntwo\nthree")
    assert list(text_lines(tmp_path / "file")) == ["one\n", "two\n", "three"]
    lines = text_lines(tmp_path / "file", longest=4)
    assert [next(lines), next(lines)] == ["one\n", "two\n"]
    with pytest.raises(OSError) as caught:
        next(lines)
    assert caught.value.strerror == "line 3 has more than 4 characters"


def test_some_memory_is_available_and_no_more_than_there_is() -> None:
    assert 1 << 20 < available_memory() <= os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 65 + "]" * 65, "text:1: not valid JSON: nested deeper than 64"),
        ('{"a": [1, 2}', "text:1: not valid JSON: Expecting ',' delimiter"),
        ('{"a":\n\n [1, 2', "text:3: not valid JSON: Expecting ',' delimiter"),
        ('{"a":\n "b\n', "text:2: not valid JSON: Invalid control character at"),
        ('["\\ud800"]', "text:1: not valid JSON: it holds half a character"),
        ("[1,\n2 3]", "text:2: not valid JSON: Expecting ',' delimiter"),
    ],
)
def test_json_is_refused_with_its_line(text: str, said: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_json(text, "text")
    assert str(caught.value).startswith(said)


def test_brackets_in_strings_and_whole_characters_are_fine() -> None:
    assert parse_json('{"]}\\"[": "\\ud83d\\ude00"}', "text") == {']}"[': "😀"}
    assert parse_json("[" * 64 + "]" * 64, "text")
