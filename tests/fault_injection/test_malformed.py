"""Malformed input gets one line, exit code 2, and no more memory than the input is worth.

A share of the cases runs by default, all with `-m malformed`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.fault_injection.malformed import fault_of, write_accepted_sample
from tests.fault_injection.malformed_cases import CASES, Case
from tests.fault_injection.samples import SAMPLES

READERS = list(dict.fromkeys(case.reader for case in CASES))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "case" in metafunc.fixturenames:
        cases = CASES if "malformed" in metafunc.config.getoption("markexpr") else _share()
        metafunc.parametrize("case", cases, ids=lambda case: f"{case.reader}: {case.file}: {case.name}")


def _share() -> list[Case]:
    """Return every sixth case, and at least four of each reader."""
    of_readers = [[case for case in CASES if case.reader == reader] for reader in READERS]
    return [case for mine in of_readers for case in mine[:: max(1, min(6, len(mine) // 4))]]


@pytest.fixture(scope="module")
def sample_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that gives the folder of a reader's valid sample."""
    folders: dict[str, Path] = {}

    def folder(reader: str) -> Path:
        if reader not in folders:
            folders[reader] = write_accepted_sample(reader, tmp_path_factory.mktemp("sample") / reader)
        return folders[reader]

    return folder


def test_there_are_hundreds_of_distinct_cases_and_every_reader_has_some() -> None:
    names = Counter((case.reader, case.file, case.name) for case in CASES)
    assert max(names.values()) == 1
    assert len(names) >= 500
    assert set(READERS) == set(SAMPLES) - {"tracker_server", "weights"}  # which have tests of their own


@pytest.mark.slow
@pytest.mark.malformed
def test_malformed_input_ends_in_one_line(case: Case, sample_of: Callable[[str], Path], tmp_path: Path) -> None:
    assert fault_of(case, sample_of(case.reader), tmp_path / "case") == ""


@pytest.mark.slow
def test_valid_input_and_files_left_behind_count_as_faults(sample_of: Callable[[str], Path], tmp_path: Path) -> None:
    def fault(corrupt: Callable[[Path], object], name: str) -> str:
        case = Case("tum", "trajectory.txt", "", corrupt, SAMPLES["tum"][0].arguments)
        return fault_of(case, sample_of("tum"), tmp_path / name)

    assert fault(lambda file: None, "valid").startswith("exit code")
    assert fault(lambda file: file.write_text("a b c\n"), "words") == ""
