"""The page of a finished map, for `modp-ti view OUT`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from modp_ti.config.settings import ViewSettings
from modp_ti.inputs.colmap_model import read_colmap_model
from modp_ti.outputs.formats.run_files import read_exposures
from modp_ti.outputs.measuring import Ruler
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.map_renderer import MapRenderer, eight_bits, start_device
from modp_ti.outputs.playback.run_frames import kept_images, pictures
from modp_ti.outputs.viewer.handover import BrowserCamera
from modp_ti.outputs.viewer.modes import MODES, SPLATS, Photograph, painter, pinhole_of, splats_of
from modp_ti.outputs.viewer.page import Page, ShownFrame
from pipelines.whole.coverage import SIDE, SeenDepth
from pipelines.whole.hierarchy import Hierarchy

# Pictures for a browser are at most this large, or as large as the run's cameras if those are larger [px].
PICTURE = 1280, 960
# Way of a camera after which a browser gets the splats of a large map again [scene depths].
MOVED = 0.1
# Maximum number of tracked points on the page. More are subsampled evenly.
MAX_POINTS = 20_000


class FinishedViewer:
    """Serves the page of a finished run until `close`.

    The thread that creates the viewer must call `serve`, which renders. If the run kept its images (`export.images`),
    the page shows the chosen frame's image and offers the error mode.

    Args:
        run: The finished run, or a file of splats (`open_splats`).
        settings: The viewer's settings.
        device: "cpu", "cuda", "vulkan", "metal" or "auto".

    Raises:
        InputError: If the page cannot be served, or the run is damaged.
    """

    def __init__(self, run: FinishedRun, settings: ViewSettings, device: str) -> None:
        self.run = run
        self._max_splats = settings.max_splats
        self._seen: list[SeenDepth] = []
        self._chosen: dict[int, int] = {}  # the frames that browsers wait for
        gaussians, points = run.gaussians, _tracked_points(run)
        self._kept = kept_images(run) is not None
        self._exposures = read_exposures(run.folder / "exposure.json") if self._kept else {}
        without = () if self._kept else ("error",) if run.folder.is_dir() else ("error", "thin")
        modes = tuple(mode for mode in MODES if mode not in without)
        self.page = Page(settings.host, settings.port, None, modes, self.choose, len(run), Ruler.of(run))
        self.url = self.page.url
        start_device(device)
        largest = (max(*(getattr(c, side) for c in run.cameras), 0) for side in ("width", "height"))
        width, height = (max(own, least) for own, least in zip(largest, PICTURE, strict=True))
        self._renderer = MapRenderer(gaussians, width, height, run.record.near)
        keyframes = run.record.keyframes
        self.page.settle(run.record.scene_depth, run.poses[keyframes[0]], run.cameras[keyframes[0]])
        self.page.show_keyframes(run.poses[keyframes], run.cameras[keyframes[0]])
        self.page.show_points(points)
        # Of a map with more splats than a browser draws, each browser gets those for its camera.
        self._detail, self._shown = None, dict[int, NDArray]()
        if len(gaussians["position"]) > settings.max_splats:
            self._detail = Hierarchy(gaussians)
        else:
            self.page.show_splats(splats_of(gaussians, self.page.units, settings.max_splats))
        frames = f"**{len(run)}** frames, {len(keyframes)} keyframes  \n" if run.folder.is_dir() else ""
        self.page.show_numbers(f"{frames}{len(gaussians['position']):,} Gaussians")
        self._renderer.view(PinholeCamera(16.0, 16.0, 8.0, 8.0, 16, 16), run.poses[0])  # compiles the kernels

    def close(self) -> None:
        """Stop serving the page."""
        self.page.close()

    def choose(self, client: int, index: int) -> None:
        """Show a frame to a browser, which `serve` does."""
        self._chosen[client] = index

    def serve(self, done: Callable[[], bool] = lambda: False) -> None:
        """Render what browsers request, until `done` returns true."""
        while not done():
            while self._chosen:
                client, index = self._chosen.popitem()
                self.page.attempt(client, partial(self._show_frame, index, client))
            camera = self.page.requests.next(timeout=0.1)
            if camera is not None:
                self.page.attempt(camera.client, partial(self._show, camera))

    def _show_frame(self, index: int, client: int) -> None:
        picture = self._photograph(index).rgba[..., :3] if self._kept else None
        self.page.show_frame(ShownFrame(self.run.poses[index], self.run.cameras[index], picture), client)

    def _show(self, browser: BrowserCamera) -> None:
        if browser.mode != SPLATS:
            self._render(browser)
        elif self._detail is not None:
            self._show_splats(browser, self._detail)

    def _render(self, browser: BrowserCamera) -> None:
        record, mapped, images = self.run.record, self.run.mapped, self._renderer.renderer.images
        paint = painter(
            browser,
            self.page.units,
            self._renderer.view,
            (images.max_width, images.max_height),
            record.scene_depth,
            self.run.poses[mapped],
            lambda index: self._photograph(mapped[index]),
            self._depths,
        )
        if paint is not None:
            self.page.show_picture(browser.client, paint())

    def _depths(self) -> list[SeenDepth]:
        """What the keyframes see, rendered at the first call."""
        if not self._seen:
            for index in self.run.record.keyframes:
                camera, T = self.run.cameras[index].within(SIDE), self.run.poses[index]
                self._seen.append(SeenDepth.of(T, camera, self._renderer.view(camera, T)))
        return self._seen

    def _show_splats(self, browser: BrowserCamera, detail: Hierarchy) -> None:
        """Show a browser the blocks of a large map, the far ones with less detail; see `Hierarchy`.

        All blocks are sent, also those behind the camera, and only after the camera has moved by `MOVED`.
        """
        seen_from = pinhole_of(browser, self.page.units, *PICTURE)
        if seen_from is None:
            return
        camera, T_camera_world = seen_from
        eye = inverse_se3(T_camera_world)[:3, 3]
        before = self._shown.get(browser.client)
        if before is not None and np.linalg.norm(eye - before) < MOVED * self.run.record.scene_depth:
            return
        self._shown = {client: at for client, at in self._shown.items() if client in self.page.requests}
        self._shown[browser.client] = eye
        blocks = np.arange(len(detail.blocks))
        levels = detail.levels_for(blocks, eye, camera.fy, self._max_splats)
        splats = splats_of(detail.gaussians(blocks, levels), self.page.units, self._max_splats)
        self.page.show_splats(replace(splats, of=len(self.run.gaussians["position"])), browser.client)

    def _photograph(self, index: int) -> Photograph:
        """Return the kept image of a frame. Raises InputError if it is missing or damaged."""
        run, camera = self.run, self.run.cameras[index]
        picture = next(pictures(run, [index]))
        rgba = np.dstack([eight_bits(picture.image), np.full(picture.image.shape[:2], 255, dtype=np.uint8)])
        if picture.mask is not None:
            rgba[~picture.mask] = 0
        return Photograph(rgba, camera, run.poses[index], self._exposures.get(index))


def _tracked_points(run: FinishedRun) -> NDArray[np.float64]:
    """Return at most MAX_POINTS points (N, 3) of the run's COLMAP model near its splats. None of a file of splats."""
    if not run.folder.is_dir():
        return np.zeros((0, 3))
    xyz = read_colmap_model(run.folder / "colmap").xyz - run.record.origin
    return xyz if len(xyz) <= MAX_POINTS else xyz[np.arange(MAX_POINTS) * len(xyz) // MAX_POINTS]
