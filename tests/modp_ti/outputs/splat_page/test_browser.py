"""The exported page in a real browser, from the disk and without network: it shows the map and flies through it."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import screenshot

from fields.geometry.camera import PinholeCamera
from modp_ti.outputs.playback.camera_paths import looking_at
from modp_ti.outputs.playback.export_map import ExportOptions, export_map
from modp_ti.outputs.playback.finished_run import open_run
from modp_ti.outputs.playback.map_renderer import MapRenderer
from modp_ti.outputs.progress import ProgressLine
from modp_ti.outputs.splat_page.flight import TO_VIEWER, level, moved, viewer_settings
from tests.patience import PATIENCE

if screenshot.missing():
    pytest.skip(screenshot.missing(), allow_module_level=True)

pytestmark = [pytest.mark.slow, pytest.mark.browser]

WIDTH, HEIGHT = 320, 240
EYE = "() => { const p = viewer.app.root.findByName('camera').getPosition(); return [p.x, p.y, p.z]; }"


@pytest.fixture
def opened(finished: Path, tmp_path: Path):
    """The run, the open page of its map, what its console said, and what it requested."""
    from playwright.sync_api import sync_playwright
    from rich.console import Console

    run = open_run(finished)
    line = ProgressLine(Console(quiet=True))
    file = export_map(run, "html", tmp_path / "map.html", ExportOptions(), line)
    executable = next(path for path in map(shutil.which, screenshot.NAMES) if path)
    with sync_playwright() as driver:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("VK_")}
        browser = driver.chromium.launch(executable_path=executable, args=screenshot.OPTIONS, env=environment)
        try:
            context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, offline=True)
            page = context.new_page()
            errors: list[str] = []
            requests: list[str] = []
            page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.on("request", lambda request: requests.append(request.url))
            page.goto(file.as_uri())
            until(page, "() => Boolean(window.viewer && viewer.state.loaded)")
            yield run, page, errors, requests, file
        finally:
            browser.close()


def until(page, condition: str) -> None:
    end = time.monotonic() + PATIENCE
    while not page.evaluate(condition):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(100)


def test_the_page_shows_the_map_and_flies_through_it_without_a_request(opened, taichi_on_the_cpu: None) -> None:
    run, page, errors, requests, file = opened
    upright = level(run.poses, run.record.scene_depth)
    track = viewer_settings(run, upright)["animTracks"][0]
    eyes = np.reshape(track["keyframes"]["values"]["position"], (-1, 3))

    # The flight runs by itself, and along the trajectory.
    places = []
    while len(places) < 5:
        places.append(page.evaluate(EYE))
        page.wait_for_timeout(200)
    assert np.ptp(places, axis=0).max() > 0
    step = np.linalg.norm(np.diff(eyes, axis=0), axis=1).max()
    assert np.linalg.norm(eyes[:, None] - places, axis=2).min(axis=0).max() <= step

    # The start view is what our renderer shows from there.
    page.evaluate("() => { viewer.state.animationPaused = true; viewer.seek(0); }")
    page.evaluate("() => { document.querySelector('.sse-ui').style.display = 'none'; }")
    until(page, f"() => {{ const p = ({EYE})(); return Math.abs(p[0] - ({eyes[0, 0]})) < 1e-3; }}")
    page.wait_for_timeout(2000)
    shown = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(np.float64)
    start = viewer_settings(run, upright)["cameras"][0]["initial"]
    T = looking_at(TO_VIEWER * start["position"], TO_VIEWER * start["target"], np.array([0.0, -1.0, 0.0]))
    focal = 0.5 * WIDTH / np.tan(np.radians(start["fov"]) / 2)
    renderer = MapRenderer(
        moved(run.gaussians, upright.R, upright.scale), WIDTH, HEIGHT, upright.scale * run.record.near
    )
    ours = renderer.picture(PinholeCamera(focal, focal, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT), T).astype(np.float64)
    psnr = -10 * np.log10(((shown - ours) ** 2).mean() / 255**2)
    mirrored = -10 * np.log10(((shown[:, ::-1] - ours) ** 2).mean() / 255**2)
    assert psnr >= 25 > mirrored, (psnr, mirrored)

    assert not errors
    assert [url for url in requests if not url.startswith(("blob:", "data:"))] == [file.as_uri()]
