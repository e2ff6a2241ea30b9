"""What is no file is refused before one waits for it, and a file costs no more than it has."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from modp_ti.files import exists, is_file, open_file, parse_json, read_bytes, text_lines
from modp_ti.files import reading as files
from modp_ti.files.errors import InputError
from modp_ti.files.reading import available_memory


def test_pipes_devices_and_folders_are_no_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path, tmp_path / "none", tmp_path / "a\0b"):
        with pytest.raises(OSError) as caught:
            read_bytes(path)
        assert caught.value.strerror
    assert not is_file(tmp_path / "pipe") and not is_file(tmp_path / ("a" * 300)) and not exists(tmp_path / "a\0b")


def test_a_file_beyond_the_memory_is_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_bytes(b"x" * 5000)
    monkeypatch.setattr(files, "available_memory", lambda: 4 * 5000)
    assert read_bytes(tmp_path / "file") == b"x" * 5000
    monkeypatch.setattr(files, "available_memory", lambda: 4 * 5000 - 1)
    with pytest.raises(OSError):
        read_bytes(tmp_path / "file")
    with open_file(tmp_path / "file") as file:
        assert file.read(2) == b"xx"


def test_lines_have_an_end(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("one\ntwo\nthree")
    assert list(text_lines(tmp_path / "file")) == ["one\n", "two\n", "three"]
    lines = text_lines(tmp_path / "file", longest=4)
    assert [next(lines), next(lines)] == ["one\n", "two\n"]
    with pytest.raises(OSError):
        next(lines)


def test_some_memory_is_available_and_no_more_than_there_is() -> None:
    assert 1 << 20 < available_memory() <= os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[" * 100_000 + "]" * 100_000, 1),
        ('{"a":' * 100_000 + "1" + "}" * 100_000, 1),
        ('{"a": [1, 2}', 1),
        ('{"a":\n\n [1, 2', 3),
        ('{"a":\n "b\n', 2),
        ('["\\ud800"]', 1),
        ("[1,\n2 3]", 2),
    ],
)
def test_json_is_refused_with_its_line(text: str, line: int) -> None:
    with pytest.raises(InputError, match=rf"^text:{line}: ") as caught:
        parse_json(text, "text")
    assert "\n" not in str(caught.value)


def test_brackets_in_strings_and_whole_characters_are_fine() -> None:
    assert parse_json('{"]}\\"[": "\\ud83d\\ude00"}', "text") == {']}"[': "😀"}
    assert parse_json("[" * 64 + "]" * 64, "text")
