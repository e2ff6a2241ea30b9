"""Take a screenshot of the viewer's page in headless Chromium: `scripts/screenshot URL FILE.png`."""

from __future__ import annotations

import argparse
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from ending import documented_ending

from modp_ti.files.errors import InputError

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
def open_page(url: str, width: int = 1000, height: int = 640) -> Iterator[Page]:
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


@documented_ending()
def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url", help="what `modp-ti run --view` or `modp-ti view` printed")
    parser.add_argument("file", help="PNG to write")
    parser.add_argument("--mode", default="splats", help="what the page shows")
    parser.add_argument("--wait", type=float, default=15.0, help="seconds for the page to show it")
    parser.add_argument("--until", help="text in the page that is waited for first, two minutes long: `frame 30`")
    arguments = parser.parse_args()
    if lacking := missing():
        raise InputError(lacking)
    with open_page(arguments.url) as page:
        if arguments.until:
            page.get_by_text(arguments.until).first.wait_for()
        if arguments.mode != "splats":
            choose_mode(page, arguments.mode)
        page.wait_for_timeout(1000 * arguments.wait)
        page.screenshot(path=arguments.file)


if __name__ == "__main__":
    main()
