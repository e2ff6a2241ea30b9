"""Pages in headless Chromium."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Page

# Software WebGL for machines without a GPU.
OPTIONS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]
NAMES = ("chromium", "chromium-browser", "google-chrome")
# Timeout for the page to load with software rendering on a busy machine [ms].
PATIENCE = 120_000


def missing() -> str | None:
    """Return what `open_page` lacks and how to install it, or None if everything is installed."""
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return "Playwright's driver is missing: pip install playwright"
    if not any(map(shutil.which, NAMES)):
        return "no Chromium: apt-get install -y chromium"
    return None


@contextmanager
def open_page(url: str, width: int = 900, height: int = 420) -> Iterator[Page]:
    """Open the viewer's page in a window of this size, and yield it once the scene is shown."""
    from playwright.sync_api import sync_playwright

    executable = next(path for path in map(shutil.which, NAMES) if path)
    with sync_playwright() as driver:
        # Chromium brings its own software Vulkan, which variables that choose the system's driver would hide.
        environment = {name: value for name, value in os.environ.items() if not name.startswith("VK_")}
        browser = driver.chromium.launch(executable_path=executable, args=OPTIONS, env=environment)
        try:
            page = browser.new_page(viewport={"width": width, "height": height})
            page.set_default_timeout(PATIENCE)
            page.goto(url)
            page.wait_for_selector("canvas")
            # viser shows a notice about software WebGL, which is always used here.
            notice = page.locator(".mantine-Notification-closeButton")
            notice.first.wait_for()
            notice.first.click()
            yield page
        finally:
            browser.close()


def choose_mode(page: Page, mode: str) -> None:
    """Select the display mode."""
    page.locator("input[role=combobox]:visible").first.click()
    page.get_by_role("option", name=mode, exact=True).click()
