"""Checks how close each threshold of the test suite is to the measured values: `pytest --spread N`, `scripts/spread`.

A passing test may depend on rounding, on one random draw or on where an optimiser converged. `--spread N` (N from 1)
runs the tests under the N-th disturbance: every seed gives another random stream, one to three threads are used, and
inputs that a test passes through `disturbed` move by one unit in the last place. All tests must still pass.

With `--spread-report FILE`, each assertion that compares numbers appends its slack to the file. The slack is the signed
distance of the value from its bound; for `assert_allclose` and `approx`, it is one minus the used fraction of the
tolerance. Positive numbers also append the logarithm of the ratio of value and bound, because an error that varies by a
factor of two is far from a bound of ten times its size. `python -m tests.spread FILE` reads the files of several
disturbances and lists the assertions whose smallest slack is less than `MARGIN` times the spread, in both measures.
Their thresholds could fail on another machine or draw.
"""

from __future__ import annotations

import ast
import json
import linecache
import os
import re
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fields.runtime.engine import engine

# Required distance between a bound and the worst draw, in units of the spread.
MARGIN = 1.0
NUMBER = r"(?:np\.\w+\()?(-?(?:\d+\.?\d*(?:e[+-]?\d+)?|inf))\)?"
COMPARISON = re.compile(rf"(?<![\w.]){NUMBER} (<=|>=|<|>) {NUMBER}(?![\w.])")

_number = 0
_report: Path | None = None
_slacks: dict[tuple[str, int, str], tuple[float, float | None]] = {}  # plain and logarithmic


def disturbance() -> int:
    """Return N of `--spread N`, 0 in an ordinary run."""
    return _number


def disturbed(values: NDArray) -> NDArray:
    """Return a copy of the values; under `--spread`, each moves up or down by one unit in the last place.

    Zeros stay, because their neighbours are denormal numbers, which kernels flush.
    """
    if not _number:
        return values.copy()
    up = _default_rng([_number, values.size]).random(values.shape) < 0.5
    moved = np.nextafter(values, np.where(up, np.inf, -np.inf).astype(values.dtype))
    return np.where(values == 0, values, moved)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--spread", type=int, default=0, metavar="N", help="the N-th disturbance of seeds, threads, inputs"
    )
    parser.addoption("--spread-report", type=Path, metavar="FILE", help="append the slack of every compared number")


def pytest_configure(config: pytest.Config) -> None:
    global _number, _report
    _number, _report = config.getoption("--spread"), config.getoption("--spread-report")
    if _number:
        os.environ[engine().variable("cpu_max_num_threads")] = str(1 + _number % 3)
        np.random.default_rng = _other_stream
    if _report:
        np.testing.assert_allclose = _recording_allclose
        _record_approx()


_default_rng = np.random.default_rng


def _other_stream(seed: object = None) -> np.random.Generator:
    """Replacement for `np.random.default_rng` with another stream per disturbance. Generators are passed through.

    The samples of `fault_injection` keep their streams: where they are cut must not become the end of a line.
    """
    if "/fault_injection/" in sys._getframe(1).f_code.co_filename:
        return _default_rng(seed)
    if isinstance(seed, int | np.integer):
        seed = [int(seed), _number]
    elif isinstance(seed, list | tuple):
        seed = [*seed, _number]
    return _default_rng(seed)


# ---- recording -----------------------------------------------------------------------------------------------


def _keep(site: tuple[str, int, str], smaller: float, larger: float) -> None:
    """Record that `smaller <= larger` was asserted."""
    slack = float(larger) - float(smaller)
    fold = float(np.log(larger / smaller)) if smaller > 0 and larger > 0 else None
    if site not in _slacks or slack < _slacks[site][0]:
        _slacks[site] = (slack, fold)


def _caller() -> tuple[str, int]:
    """Return file (below `tests/`) and line of the innermost stack frame of a test."""
    frame = sys._getframe(2)
    while "/tests/" not in frame.f_code.co_filename or frame.f_code.co_filename == __file__:
        frame = frame.f_back
    return frame.f_code.co_filename.rpartition("/tests/")[2], frame.f_lineno


def _used(actual: object, desired: object, rtol: object, atol: object) -> float:
    """Return the largest fraction of the tolerance that a difference uses."""
    a, d = np.broadcast_arrays(np.asarray(actual, dtype=np.float64), np.asarray(desired, dtype=np.float64))
    finite = np.isfinite(a) & np.isfinite(d)
    allowed = np.broadcast_to(atol + rtol * np.abs(d), a.shape)[finite]
    off = np.abs(a - d)[finite]
    return float((off[off > 0] / np.maximum(allowed[off > 0], 1e-300)).max(initial=0.0))


_assert_allclose = np.testing.assert_allclose


def _recording_allclose(actual, desired, rtol=1e-7, atol=0, *arguments, **options) -> None:
    _assert_allclose(actual, desired, rtol, atol, *arguments, **options)
    _keep((*_caller(), "assert_allclose"), _used(actual, desired, rtol, atol), 1.0)


def _record_approx() -> None:
    ApproxScalar = type(pytest.approx(1.0))
    compare = ApproxScalar.__eq__

    def recording(self: object, actual: object) -> bool:
        equal = compare(self, actual)
        # The tolerance of an expected NaN cannot be asked for.
        if equal and isinstance(actual, int | float | np.number) and np.isfinite(self.expected):
            _keep((*_caller(), "approx"), _used(actual, self.expected, 0.0, self.tolerance), 1.0)
        return equal

    ApproxScalar.__eq__ = recording


def pytest_assertion_pass(item: pytest.Item, lineno: int, orig: str, expl: str) -> None:
    """Record the slack of a passing comparison.

    The hook needs `-o enable_assertion_pass_hook=true`, which `scripts/spread` sets.
    """
    if _report is None:
        return
    if orig.partition("\n")[0] not in linecache.getline(str(item.path), lineno):
        return  # assertion of a plugin
    site = (str(item.path).rpartition("/tests/")[2], lineno, orig)
    low = _lower_bound(orig)
    for left, operator, right in COMPARISON.findall(expl.partition("\n")[0]):
        smaller, larger = (left, right) if operator[0] == "<" else (right, left)
        _keep(site, float(smaller), float(larger))
        if low is not None:  # in a chain, the explanation contains only the last comparison
            _keep((*site[:2], f"{orig} [{low}]"), low, float(left))


def _lower_bound(source: str) -> float | None:
    """Return the number `low` of an assertion `low < value < high`, None for others."""
    try:
        test = ast.parse(source.strip(), mode="eval").body
    except SyntaxError:
        return None
    match test:
        case ast.Compare(left=ast.Constant(value=int() | float() as low), ops=[ast.Lt() | ast.LtE(), _]):
            return float(low)
    return None


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    if _report is None or not _slacks:
        return
    with open(f"{_report}.{os.environ.get('PYTEST_XDIST_WORKER', 'main')}", "a") as file:
        for (where, line, text), (slack, fold) in _slacks.items():
            about = {"test": item.nodeid, "site": f"{where}:{line}", "text": text, "draw": _number}
            about |= {"slack": slack, "fold": fold}
            file.write(json.dumps(about) + "\n")
    _slacks.clear()


# ---- the table -----------------------------------------------------------------------------------------------


def table(files: list[Path]) -> list[tuple[float, str]]:
    """Return (smallest slack in spreads, row) of every assertion, the closest to failing first."""
    slacks: dict[tuple[str, str, str], dict[int, tuple[float, float | None]]] = defaultdict(dict)
    for file in files:
        for line in file.read_text().splitlines():
            row = json.loads(line)
            found = slacks[row["test"], row["site"], row["text"]]
            if row["draw"] not in found or row["slack"] < found[row["draw"]][0]:
                found[row["draw"]] = (row["slack"], row["fold"])
    rows = []
    for (test, site, text), by_draw in slacks.items():
        found, folds = zip(*by_draw.values(), strict=True)
        found = np.array(found)
        spread = float(np.ptp(found))
        if spread > 0 and np.isfinite(found).all():
            ratio = float(found.min()) / spread
            if None not in folds:
                ratio = max(ratio, min(folds) / max(float(np.ptp(folds)), 1e-12))
            of = test.partition("::")[2]
            rows.append(
                (ratio, f"{ratio:8.2f} {found.min():12.4g} {spread:12.4g} {len(found):3d}  {site} {of}: {text}")
            )
    return sorted(rows)


def main() -> None:
    rows = table([Path(name) for name in sys.argv[1:]])
    print("  margin smallest slack    spread draws")
    for ratio, row in rows:
        if ratio < MARGIN:
            print(row)
    near = sum(ratio < MARGIN for ratio, _ in rows)
    print(f"{len(rows)} assertions vary; {near} have less than {MARGIN:g} spread between the worst draw and the bound")


if __name__ == "__main__":
    main()
