"""The report in a real browser, in the windows of a phone and of a desk, in light and dark colours."""

from __future__ import annotations

import shutil
from collections.abc import Iterator

import pytest

from modp_ti.outputs.report.page import write_report
from tests import chromium
from tests.modp_ti.outputs.report.made_up_run import made_up_run

if chromium.missing():
    pytest.skip(chromium.missing(), allow_module_level=True)

pytestmark = [pytest.mark.slow, pytest.mark.browser]

CELLS = "[...document.querySelectorAll('td, th')].filter(e => e.textContent.trim().length > 8).map(e => e.clientWidth)"
CUT = """[...document.querySelectorAll('*')].filter(e => e.scrollWidth > e.clientWidth + 1 && e.clientWidth
         && !['auto', 'visible'].includes(getComputedStyle(e).overflowX)).length"""
COLOURS = (
    "e => [getComputedStyle(e).color, getComputedStyle(e).backgroundColor].map(c => c.match(/[0-9]+/g).map(Number))"
)


@pytest.fixture(scope="module")
def address(tmp_path_factory) -> str:
    folder = tmp_path_factory.mktemp("report")
    write_report(folder / "report.html", made_up_run(folder, size=(240, 320), notes=("a note: " + "long_word" * 30,)))
    return (folder / "report.html").as_uri()


@pytest.fixture(scope="module")
def window() -> Iterator:
    from playwright.sync_api import sync_playwright

    executable = next(path for path in map(shutil.which, chromium.NAMES) if path)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=executable, args=chromium.OPTIONS)
        yield browser
        browser.close()


def luminance(colour: list[float]) -> float:
    """The relative luminance of an sRGB colour [WCAG 2]."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in colour[:3])]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [320, 1000])
def test_the_page_fits_its_window_and_is_legible(window, address: str, width: int, scheme: str) -> None:
    context = window.new_context(viewport={"width": width, "height": 844}, is_mobile=width < 500, color_scheme=scheme)
    page = context.new_page()
    page.goto(address)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert min(page.evaluate(CELLS)) > 60, "no column is squeezed to a letter a line"
    assert page.evaluate(CUT) == 0
    shown, behind = map(luminance, page.eval_on_selector("body", COLOURS))
    assert (behind < 0.1) == (scheme == "dark")
    assert (max(shown, behind) + 0.05) / (min(shown, behind) + 0.05) > 7
    # The text of the drawings has 9 of 662 points; a phone scrolls them.
    sizes = page.evaluate("[...document.querySelectorAll('.drawing img')].map(e => 9 / 662 * e.clientWidth)")
    assert sizes and min(sizes) > 8
    context.close()
