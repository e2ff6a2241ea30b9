"""Exported pages in a real browser: from the disk and without network, and streamed from a server."""

from __future__ import annotations

import os
import re
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import camera_centres
from fields.map.gaussians import SH_C0
from modp_ti.outputs.formats.collision import boundary
from modp_ti.outputs.playback.camera_paths import looking_at
from modp_ti.outputs.playback.export_map import ExportOptions, export_map
from modp_ti.outputs.playback.finished_run import FinishedRun, open_run
from modp_ti.outputs.playback.map_renderer import MapRenderer
from modp_ti.outputs.progress import ProgressLine
from modp_ti.outputs.splat_page.page import (
    EYE_HEIGHT,
    TO_VIEWER,
    Levelled,
    level,
    moved,
    page_glb,
    viewer_settings,
    write_splat_page,
)
from pipelines.surface.free_space import carved, walkable
from pipelines.whole.hierarchy import LEVELS
from tests import chromium
from tests.modp_ti.outputs.splat_page.test_page import finished as recorded
from tests.patience import PATIENCE
from tests.pipelines.surface.test_free_space import looking_around, true_views
from tests.room import HIGH, LOW, Room, look_at

if chromium.missing():
    pytest.skip(chromium.missing(), allow_module_level=True)

pytestmark = [pytest.mark.slow, pytest.mark.browser]

WIDTH, HEIGHT = 320, 240
EYE = "() => { const p = viewer.app.root.findByName('camera').getPosition(); return [p.x, p.y, p.z]; }"


HIDE_CONTROLS = "() => { document.querySelector('.sse-ui').style.display = 'none'; }"
SHOWN = "() => Boolean(window.viewer && viewer.state.loaded)"


@contextmanager
def opened(url: str, offline: bool) -> Iterator[tuple]:
    """The open page of a map, what its console said, and what it requested."""
    from playwright.sync_api import sync_playwright

    executable = next(path for path in map(shutil.which, chromium.NAMES) if path)
    with sync_playwright() as driver:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("VK_")}
        browser = driver.chromium.launch(executable_path=executable, args=chromium.OPTIONS, env=environment)
        try:
            context = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, offline=offline)
            page = context.new_page()
            errors: list[str] = []
            requests: list[str] = []
            page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.on("request", lambda request: requests.append(request.url))
            page.goto(url)
            until(page, SHOWN)
            yield page, errors, requests
        finally:
            browser.close()


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a server of a folder."""

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def exported(finished: Path, format: str, target: Path) -> tuple[FinishedRun, Path]:
    from rich.console import Console

    run = open_run(finished)
    return run, export_map(run, format, target, ExportOptions(), ProgressLine(Console(quiet=True)))


def until(page, condition: str) -> None:
    end = time.monotonic() + PATIENCE
    while not page.evaluate(condition):
        assert time.monotonic() < end, condition
        page.wait_for_timeout(100)


def upright_in(page, run: FinishedRun) -> Levelled:
    """What makes the map upright, with the page's scale."""
    scale = page.evaluate("() => document.getElementById('world') && 1 / JSON.parse(text('world')).scale")
    found = level(run.poses, run.record.scene_depth)
    return replace(found, scale=scale or found.scale)


def eyes_of(page, run: FinishedRun) -> np.ndarray:
    track = viewer_settings(run, upright_in(page, run))["animTracks"][0]
    return np.reshape(track["keyframes"]["values"]["position"], (-1, 3))


def start_views(page, run: FinishedRun) -> tuple[np.ndarray, np.ndarray]:
    """What the page shows at the start of the flight, and what our renderer shows from there."""
    eye, upright = eyes_of(page, run)[0], upright_in(page, run)
    page.evaluate("() => { viewer.state.animationPaused = true; viewer.seek(0); }")
    page.evaluate(HIDE_CONTROLS)
    page.evaluate("() => document.getElementById('measuring')?.remove()")
    until(page, f"() => {{ const p = ({EYE})(); return Math.abs(p[0] - ({eye[0]})) < 1e-3; }}")
    page.wait_for_timeout(2000)
    shown = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(np.float64)
    start = viewer_settings(run, upright)["cameras"][0]["initial"]
    T = looking_at(TO_VIEWER * start["position"], TO_VIEWER * start["target"], np.array([0.0, -1.0, 0.0]))
    focal = 0.5 * WIDTH / np.tan(np.radians(start["fov"]) / 2)
    renderer = MapRenderer(
        moved(run.gaussians, upright.R, upright.scale), WIDTH, HEIGHT, upright.scale * run.record.near
    )
    ours = renderer.picture(PinholeCamera(focal, focal, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT), T)
    return shown, ours.astype(np.float64)


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(((one - other) ** 2).mean() / 255**2))


def test_the_page_shows_the_map_and_flies_through_it_without_a_request(
    finished: Path, tmp_path: Path, taichi_on_the_cpu: None
) -> None:
    run, file = exported(finished, "html", tmp_path / "map.html")
    with opened(file.as_uri(), offline=True) as (page, errors, requests):
        # The flight runs by itself, and along the trajectory.
        eyes, places = eyes_of(page, run), [page.evaluate(EYE)]
        until(page, f"() => ({EYE})().some((x, i) => Math.abs(x - {places[0]}[i]) > 1e-6)")
        while len(places) < 5:
            places.append(page.evaluate(EYE))
            page.wait_for_timeout(200)
        step = np.linalg.norm(np.diff(eyes, axis=0), axis=1).max()
        assert np.linalg.norm(eyes[:, None] - places, axis=2).min(axis=0).max() <= step

        # The start view is what our renderer shows from there.
        shown, ours = start_views(page, run)
        assert psnr(shown, ours) >= 25 > psnr(shown[:, ::-1], ours)
        assert not errors
        assert [url for url in requests if not url.startswith(("blob:", "data:"))] == [file.as_uri()]


def room_of_splats(room: Room, eye: np.ndarray) -> dict[str, np.ndarray]:
    """The room's surface around a place as opaque discs, with thin fog halfway to it."""
    rng = np.random.default_rng(4)
    rays = rng.normal(size=(60_000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    colour, t, normal = room.shaded(eye, rays)
    count, fog = len(rays), len(rays) // 20
    t[:fog] *= 0.5
    normal[:fog] = rays[:fog]
    turn = Rotation.concatenate([Rotation.align_vectors(n, [0, 0, 1])[0] for n in normal])
    sh = np.zeros((count, 4, 3), np.float32)
    sh[:, 0] = (colour - 0.5) / SH_C0
    return {
        "position": (eye + t[:, None] * rays).astype(np.float32),
        "log_scale": np.log(0.03 * t[:, None] * [1.0, 1.0, 0.02]).astype(np.float32),
        "quaternion": turn.as_quat(scalar_first=True).astype(np.float32),
        "opacity_logit": np.where(np.arange(count) < fog, -2.5, 3.0).astype(np.float32),
        "sh": sh,
    }


def test_clicks_measure_the_true_lengths_of_a_room(tmp_path: Path, room: Room) -> None:
    eye, ahead = np.array([0.3, -1.4, 1.4]), np.array([0.1, 2.0, 1.4])
    run = recorded(look_at(eye, ahead)[None], np.zeros(1))
    upright = replace(level(run.poses, run.record.scene_depth), scale=1.0)
    settings, state = viewer_settings(run, upright), room_of_splats(room, eye)
    world = {"unit": "m", "scale": 1.0, "deviation": 0.0, "floor": 0.0}
    write_splat_page(tmp_path / "map.html", "room", settings, moved(state, upright.R, 1.0), world)
    camera = run.cameras[0].resized(WIDTH, HEIGHT)
    pixels = np.array([[105.0, 60.0], [220.0, 55.0], [230.0, 95.0]])
    rays = camera.unproject(pixels, np.ones(3)) @ run.poses[0, :3, :3]
    true = eye + room.cast(eye, rays)[0][:, None] * rays
    with opened((tmp_path / "map.html").as_uri(), offline=True) as (page, errors, _):
        page.evaluate(HIDE_CONTROLS)
        page.click("#measure")
        said = []
        for pixel in pixels:
            page.mouse.click(*pixel)
            until(page, f"() => document.querySelectorAll('#drawing circle').length > {len(said)}")
            said.append(page.inner_text("#measured"))
        assert not errors
    numbers = [dict(re.findall(r"^(.*?) (\S+) \u00b1 \S+ m\u00b2?$", text, re.MULTILINE)) for text in said]
    assert np.linalg.norm(true[1] - true[0]) == pytest.approx(2.0, abs=0.1)
    for name, found, expected in (
        ("height over the floor", numbers[0], true[0, 2]),
        ("length", numbers[1], np.linalg.norm(true[1] - true[0])),
        ("last", numbers[2], np.linalg.norm(true[2] - true[1])),
        ("area", numbers[2], 0.5 * np.linalg.norm(np.cross(true[1] - true[0], true[2] - true[0]))),
    ):
        assert float(found[name]) == pytest.approx(expected, abs=0.01)


def test_walking_stays_in_the_room_and_above_its_floor(tmp_path: Path, room: Room, taichi_on_the_cpu: None) -> None:
    poses = looking_around(40)
    run = recorded(poses, np.arange(40.0))
    upright = replace(level(poses, run.record.scene_depth), scale=1.0)
    R_grid_world = np.stack([upright.R[0], upright.R[2], -upright.R[1]])
    space = carved(true_views(room, poses), [camera_centres(poses)], R_grid_world, 0.1, 10.0)
    floor = space.floor(1.3)
    assert floor is not None
    shape = page_glb(boundary(space, walkable(space, camera_centres(poses), floor)), upright)
    state = moved(room_of_splats(room, poses[0, :3, :3].T @ -poses[0, :3, 3]), upright.R, 1.0)
    settings = viewer_settings(run, upright)
    write_splat_page(tmp_path / "map.html", "room", settings, state, {"floor": floor}, shape)
    places = []
    with opened((tmp_path / "map.html").as_uri(), offline=True) as (page, errors, _):
        page.evaluate(HIDE_CONTROLS)
        page.click("#walk")
        for keys in ("w", "d", "wd", "s", "a", "sa", "w", "wa"):
            for key in keys:
                page.keyboard.down(key)
            for _ in range(8):
                page.wait_for_timeout(150)
                places.append(page.evaluate(EYE))
            for key in keys:
                page.keyboard.up(key)
        assert not errors
    eyes = TO_VIEWER * places @ upright.R  # back in the room
    assert np.linalg.norm(np.diff(eyes, axis=0), axis=1).sum() > 10.0
    assert ((eyes[:, :2] > LOW[:2]) & (eyes[:, :2] < HIGH[:2])).all()
    assert room.distance(eyes).min() > 0.1  # also of furniture
    assert np.abs(eyes[8:, 2] - EYE_HEIGHT).max() < 0.3


def test_a_browser_streams_levels_of_detail_from_a_server(
    finished: Path, tmp_path: Path, taichi_on_the_cpu: None
) -> None:
    run, folder = exported(finished, "sog-lod", tmp_path / "lod")
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    quality = []
    with served(folder) as url:
        with opened(f"{url}/index.html?budget=1.0", offline=False) as (page, errors, requests):
            quality.append(psnr(*start_views(page, run)))
            # A hundredth of it [millions].
            page.goto(f"{url}/index.html?budget={1e-8 * len(run.gaussians['position']):.7f}")
            until(page, SHOWN)
            quality.append(psnr(*start_views(page, run)))
            # From the disk, a browser does not load it, and the page says so.
            page.goto((folder / "index.html").as_uri())
            until(page, "() => Boolean(document.querySelector('.notice')?.innerText.trim())")
        wanted = {request.removeprefix(f"{url}/") for request in requests if request.startswith(url)}
    assert not errors
    assert {"lod-meta.json", f"{LEVELS}_0/meta.json"} <= wanted  # the coarsest level comes first
    assert {name.split("?")[0] for name in wanted} <= files
    assert quality[0] >= 25 and quality[0] > quality[1] + 3 > 10
