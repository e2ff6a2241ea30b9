"""The page in a real browser, while a run maps: it shows the map and the lag, and its buttons hold the run."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
import zipfile
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


# The same at the camera's pace, which nobody waits for while the run holds.
LIVE = """
source:  {path: images, fps: 10, realtime: true, intrinsics: {fx: 120, fy: 120, cx: 80, cy: 60}}
tracker: {kind: klt}
output:  out
device:  cpu
refine:  {steps: 0}
export:  {report: false, session: true}
view:    {port: 0, paused: true}
"""

pytestmark = [pytest.mark.slow, pytest.mark.browser]


@pytest.fixture
def run(tmp_path: Path, room: Room, request: pytest.FixtureRequest) -> Iterator[tuple[subprocess.Popen, str]]:
    """A run of the scene, or of the one that the test gives, which holds after its first frame; where its page is."""
    from tests.room import RoomRecording, pinhole, walk

    scene = getattr(request, "param", SCENE)
    RoomRecording(room, pinhole(160, 120) if scene == LIVE else pinhole(80, 60), walk(24)).write(tmp_path)
    (tmp_path / "scene.yaml").write_text(scene)
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
    encoded = page.screenshot(clip={"x": 0, "y": 0, "width": 600, "height": 640})
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


def shown_lag(page) -> tuple[int, str]:
    """The number of frames and the lag [s] that the page shows; 0 before there is one."""
    found = re.search(r"frame (\d+).*?lag ([\d.]+) s", page.locator("body").inner_text(), re.DOTALL)
    return (int(found[1]), found[2]) if found else (0, "")


@pytest.mark.parametrize("run", [LIVE], indirect=True)
def test_the_page_shows_the_lag_that_the_session_records(run: tuple[subprocess.Popen, str], tmp_path: Path):
    process, url = run
    shown: dict[int, str] = {}
    with chromium.open_page(url) as page:
        wait_until(page, lambda: shown_lag(page)[0] == 1)
        for number in (2, 3, 4, 5):  # the stream goes on meanwhile, so that each frame is later than the one before
            page.get_by_role("button", name="Step").click()
            wait_until(page, lambda number=number: shown_lag(page)[0] == number)
            shown.update([shown_lag(page)])
        page.get_by_role("button", name="Resume").click()
        while process.poll() is None and "evaluating" not in page.locator("body").inner_text():
            shown.update([shown_lag(page)])
    assert process.wait(timeout=PATIENCE) == 0
    with zipfile.ZipFile(tmp_path / "out" / "session.zip") as session:
        lag = json.loads(session.read("about.json"))["lag"]
    shown.pop(0, None)
    assert len(shown) > 3
    assert shown == {number: f"{lag[number - 1]:.1f}" for number in shown}
