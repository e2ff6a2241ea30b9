"""What is wrong with an input is said in one line, and costs no more memory than the input is worth."""

from __future__ import annotations

from collections import Counter

import pytest
from fault_injection.malformed import malformed_inputs, markdown, run_case
from fault_injection.malformed_cases import CASES, Case
from fault_injection.samples import SAMPLES, write_sample

pytestmark = pytest.mark.slow

READERS = list(dict.fromkeys(case.reader for case in CASES))


def test_there_are_hundreds_of_distinct_cases_and_every_reader_has_some() -> None:
    names = Counter((case.reader, case.file, case.name) for case in CASES)
    assert max(names.values()) == 1
    assert len(names) >= 500
    assert set(READERS) == set(SAMPLES) - {"tracker_server", "weights"}  # which have tests of their own


@pytest.mark.parametrize("reader", READERS)
def test_a_part_of_them_ends_in_one_line(reader: str) -> None:
    """Every sixth here; `scripts/fault_injection/malformed.py` runs all."""
    mine = [case for case in CASES if case.reader == reader]
    chosen = mine[:: max(1, min(6, len(mine) // 4))]
    outcomes = list(malformed_inputs(cases=chosen))
    assert [(o.case.file, o.case.name, o.fault, o.line) for o in outcomes if o.fault] == []
    assert f"| {reader} | {len(chosen)} | {len(chosen)} |" in markdown(outcomes)


def test_what_is_no_error_is_noticed(tmp_path) -> None:
    """A check of the check itself: a valid input, one that leaves a file, and one that takes memory are faults."""
    write_sample("tum", tmp_path / "sample")
    arguments = SAMPLES["tum"][0].arguments

    def fault(corrupt) -> str:
        return run_case(
            Case("tum", "trajectory.txt", "", corrupt, arguments), tmp_path / "sample", tmp_path / "case"
        ).fault

    assert fault(lambda file: None).startswith("exit code")
    assert fault(lambda file: file.write_text("a b c\n")) == ""
