"""Debian's Chromium without a screen, driven by Playwright: for pictures of the viewer's page, and for its test."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Page

# Where there is no GPU, WebGL is drawn by the processor.
OPTIONS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]
NAMES = ("chromium", "chromium-browser", "google-chrome")
# Milliseconds that a page may take to come up, drawn by a busy processor.
PATIENCE = 120_000


def missing() -> str | None:
    """What there is not for `open_page`, and how to get it; None where all is there."""
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return "Playwright's driver is missing: pip install playwright"
    if not any(map(shutil.which, NAMES)):
        return "no Chromium: apt-get install -y chromium"
    return None


@contextmanager
def open_page(url: str, width: int = 1000, height: int = 640) -> Iterator[Page]:
    """The viewer's page in a window of this size, once its scene is there."""
    from playwright.sync_api import sync_playwright

    executable = next(path for path in map(shutil.which, NAMES) if path)
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=executable, args=OPTIONS)
        try:
            page = browser.new_page(viewport={"width": width, "height": height})
            page.set_default_timeout(PATIENCE)
            page.goto(url)
            page.wait_for_selector("canvas")
            # viser says where WebGL is drawn by the processor; here it always is.
            notice = page.locator(".mantine-Notification-closeButton")
            notice.first.wait_for()
            notice.first.click()
            yield page
        finally:
            browser.close()


def choose_mode(page: Page, mode: str) -> None:
    """Choose what the page shows."""
    page.locator("input[role=combobox]:visible").first.click()
    page.get_by_role("option", name=mode, exact=True).click()
