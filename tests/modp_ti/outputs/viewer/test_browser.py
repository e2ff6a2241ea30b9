"""The page in a real browser, while a run maps: it shows the map, and its buttons hold the run."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from tests import chromium
from tests.patience import PATIENCE

if TYPE_CHECKING:
    from tests.room import Room

if chromium.missing():
    pytest.skip(chromium.missing(), allow_module_level=True)

SCENE = """
source:  {path: images, fps: 10}
tracker: {kind: colmap, path: sparse/0}
output:  out
device:  cpu
mapping: {optimise: {steps: 3}}
refine:  {steps: 0}
view:    {port: 0, paused: true}
"""


pytestmark = [pytest.mark.slow, pytest.mark.browser]


@pytest.fixture
def run(tmp_path: Path, room: Room) -> Iterator[tuple[subprocess.Popen, str]]:
    """A run that holds after its first frame, and where its page is."""
    from tests.room import RoomRecording, pinhole, walk

    RoomRecording(room, pinhole(80, 60), walk(24)).write(tmp_path)
    (tmp_path / "scene.yaml").write_text(SCENE)
    command = [sys.executable, "-m", "modp_ti.run", str(tmp_path / "scene.yaml")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        said = next(line for line in process.stdout if line.startswith("viewer: "))
        yield process, said.split()[1]
    finally:
        process.kill()
        process.wait()


def frame_number(page) -> int:
    """What the frame counter says."""
    found = re.search(r"frame (\d+) of 24", page.locator("body").inner_text())
    return int(found[1]) if found else 0


def wait_until(page, happens) -> None:
    end = time.monotonic() + PATIENCE
    while not happens():
        assert time.monotonic() < end, page.locator("body").inner_text()
        page.wait_for_timeout(100)


def picture(page) -> np.ndarray:
    """The canvas (H, W, 3), left of the controls."""
    encoded = page.screenshot(clip={"x": 0, "y": 0, "width": 520, "height": 420})
    return cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR).astype(int)


def drawn(page) -> float:
    """Share of the canvas that is not the background."""
    image = picture(page)
    return float((np.abs(image - np.median(image[:8], axis=(0, 1))).max(axis=2) > 24).mean())


def colourful(page) -> float:
    """Share of the canvas that is not grey."""
    return float((np.ptp(picture(page), axis=2) > 24).mean())


def test_the_page_shows_the_map_and_its_buttons_hold_the_run(run: tuple[subprocess.Popen, str]):
    process, url = run
    with chromium.open_page(url) as page:
        wait_until(page, lambda: frame_number(page) == 1)
        for number in (2, 3, 4):
            page.get_by_role("button", name="Step").click()
            wait_until(page, lambda number=number: frame_number(page) == number)
        wait_until(page, lambda: drawn(page) > 0.02 and colourful(page) > 0.01)  # splats

        # Another browser, on a phone, has a mode and a scale of its own.
        other = page.context.browser.new_page(viewport={"width": 390, "height": 844})
        other.goto(url)
        wait_until(other, lambda: "Link to this view" in other.locator("body").inner_text())
        chromium.choose_mode(other, "depth")
        wait_until(other, lambda: "scene units" in other.locator("body").inner_text())
        assert "scene units" not in page.locator("body").inner_text()
        other.close()

        # Our renderer's opacity: grey, from where the browser looks.
        for box in ("Keyframes", "Current frame", "Tracked points"):
            page.get_by_role("checkbox", name=box).click()
        chromium.choose_mode(page, "opacity")
        wait_until(page, lambda: drawn(page) > 0.01 and colourful(page) < 0.001)

        page.get_by_role("button", name="Resume").click()
        wait_until(page, lambda: frame_number(page) >= 6)
        page.get_by_role("button", name="Pause").click()
        page.get_by_text("paused").wait_for()
        held = frame_number(page)
        assert held < 24
        page.wait_for_timeout(2000)
        assert frame_number(page) == held
        page.get_by_role("button", name="Step").click()
        wait_until(page, lambda: frame_number(page) == held + 1)
    # The browser is closed while the run is paused: it goes on, and ends well.
    assert process.wait(timeout=PATIENCE) == 0
