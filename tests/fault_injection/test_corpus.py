"""What the fuzzer has found is read again: every input of the corpus is taken or refused with an InputError."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest

from tests.fault_injection.readers import READERS, seeds

CORPUS = Path(__file__).resolve().parents[1] / "corpus"


@pytest.mark.parametrize("name", READERS)
def test_the_corpus_of_a_reader_does_no_harm(name: str, tmp_path: Path) -> None:
    reader = READERS[name]
    for seed in seeds(reader, tmp_path / "sample"):
        assert reader(tmp_path / "sample", seed), "the sample itself is taken"
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # as the fuzzer has it
        for file in sorted((CORPUS / name).glob("*")):
            reader(tmp_path / "sample", file.read_bytes())


def test_the_corpus_is_of_readers_that_there_are_and_small() -> None:
    files = [file for file in CORPUS.rglob("*") if file.is_file()]
    assert {file.parent.name for file in files} <= set(READERS)
    assert sum(file.stat().st_size for file in files) < 1 << 20
