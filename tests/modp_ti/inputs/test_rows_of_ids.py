"""Rows of ids, beside a dictionary."""

from __future__ import annotations

import numpy as np
import pytest

from modp_ti.inputs import rows_of_ids
from modp_ti.inputs.rows_of_ids import RowsOfIds


def test_rows_are_those_of_a_dictionary(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rows_of_ids, "RECENT", 20)
    rng, rows, expected = np.random.default_rng(1), RowsOfIds(), {}
    for frame in range(60):
        ids = rng.integers(-50, 50 + 20 * frame, 40)  # some known, some new, some twice
        np.testing.assert_array_equal(rows.find(ids), [expected.get(i, -1) for i in ids.tolist()])
        np.testing.assert_array_equal(rows.take(ids), [expected.setdefault(i, len(expected)) for i in ids.tolist()])
        assert len(rows) == len(expected)
        np.testing.assert_array_equal(rows.ids, list(expected))
    again = RowsOfIds(rows.ids)
    ids = np.array([*expected, 10**12, -(2**62)])
    np.testing.assert_array_equal(again.find(ids), [*expected.values(), -1, -1])


def test_no_ids_have_no_rows() -> None:
    rows, none = RowsOfIds(), np.zeros(0, dtype=np.int64)
    assert len(rows.find(none)) == len(rows.take(none)) == len(rows) == len(rows.ids) == 0
    np.testing.assert_array_equal(rows.find(np.array([3])), [-1])
