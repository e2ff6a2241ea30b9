"""`LiveViewer`: shows the map in a browser while it grows."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.config.settings import ViewSettings
from modp_ti.engine.mapper import Mapper
from modp_ti.engine.stream import Observer
from modp_ti.outputs.progress import LiveStatus
from modp_ti.outputs.viewer.handover import BrowserCamera, CostLimit, Gate, Latest, ThreadClock
from modp_ti.outputs.viewer.modes import SPLATS, Photograph, painter, splats_of
from modp_ti.outputs.viewer.page import Page, ShownFrame
from pipelines.pipeline import FrameReport
from pipelines.render.renderer import RenderedView
from pipelines.whole.coverage import SIDE, SeenDepth

# Fraction of the allowed cost that is budgeted. The rest covers what is not measured: contention for the GIL and for
# the caches between the viewer's threads and the mapper.
PLANNED = 0.7
# Fraction of the budget for the numbers and the current frame, which are cheap. The rest goes to pictures and splats.
FOR_NUMBERS = 0.25
# Minimum time between two updates of the numbers [s].
NUMBERS_EVERY = 0.1
# Maximum width of the current frame's picture [px]; the finest pyramid level within it is shown.
THUMBNAIL = 320
# Relative change of a keyframe's pose from which on it is rendered again for the thin places.
STAYS = 0.02
# Time after which a paused run resumes if the browser that paused it, or the last one, has disconnected [s].
PATIENCE = 5.0


@dataclass(frozen=True)
class Update:
    """What the page should show next. A part that is None stays as it is.

    All arrays are on the host and owned by the update. The publishing thread computes the final form of `splats` and
    `picture`.

    Attributes:
        numbers: Markdown text.
        frame: The current frame.
        points: (N, 3) tracked points in the world.
        keyframes: (N, 4, 4) T_camera_world of the keyframes, and the camera of the first.
        splats: Gaussians by name, as from `GaussianField.to_numpy`.
        picture: The browser's id, and a function that computes its picture.
    """

    numbers: str | None = None
    frame: ShownFrame | None = None
    points: NDArray[np.float64] | None = None
    keyframes: tuple[NDArray[np.float64], PinholeCamera] | None = None
    splats: dict[str, NDArray] | None = None
    picture: tuple[int, Callable[[], NDArray[np.uint8]]] | None = None

    def over(self, waiting: Update) -> Update:
        """Return this update, with missing parts taken from the older update `waiting`."""
        return replace(waiting, **{name: part for name, part in vars(self).items() if part is not None})


class LiveViewer(Observer):
    """An `Observer` that serves a page with the growing map.

    It never waits for a browser, and keeps its cost below `settings.max_cost` percent of the mapping time. Only the
    mapping thread accesses the map: between frames and steps, as often as the cost allows, it renders the requested
    pictures and copies what is shown. A viewer thread turns them into images and messages, and viser's threads send
    them.

    Args:
        settings: The viewer's settings.
        say: Called with one line if the viewer fails. The run continues without it.

    Raises:
        InputError: If the page cannot be served.
    """

    def __init__(self, settings: ViewSettings, say: Callable[[str], None], clock=time.perf_counter) -> None:
        self.settings = settings
        self.waited = 0.0
        self._say = say
        self._clock = clock
        self._gate = Gate()
        self._gate.pause(settings.paused)
        self.page = Page(settings.host, settings.port, self._gate)
        self.url = self.page.url
        share = PLANNED * settings.max_cost / 100.0
        self.numbers_limit = CostLimit(FOR_NUMBERS * share, clock)
        self.pictures_limit = CostLimit((1 - FOR_NUMBERS) * share, clock)
        self._updates: Latest[Update] = Latest(lambda newer, waiting: newer.over(waiting))
        self._publisher = threading.Thread(target=self._publish, name="viewer", daemon=True)
        self._publisher.start()
        self._serving = ThreadClock([self._publisher, *self.page.threads])
        self._mapper: Mapper  # from `begin` on
        self._frame: TrackedFrame | None = None
        self._state = self._psnr = ""
        self._frames: int | None = None
        self._began = clock()
        self._numbers_at = -np.inf
        self._visited = False  # whether any browser has connected
        self._behind = True  # the page's splats are older than the map
        self._failed = False
        self._seen: dict[int, SeenDepth] = {}  # of the keyframes, for the mode of thin places

    def close(self) -> None:
        """Stop serving the page."""
        self._updates.close()
        self._publisher.join(timeout=5.0)
        self.page.close()

    @property
    def cost(self) -> float:
        """Seconds spent on the viewer so far: wall time of the mapping thread plus CPU time of the viewer's threads."""
        return self.numbers_limit.cost + self.pictures_limit.cost

    # ---- the observer ----------------------------------------------------------------------------------------

    def begin(self, mapper: Mapper, frames: int | None) -> None:
        self._mapper, self._frames = mapper, frames
        self._began = self._clock()
        self._serving.since_last()  # do not charge for browsers that connected before mapping began

    def on_frame(self, frame: TrackedFrame, report: FrameReport | None, live: LiveStatus | None = None) -> None:
        self._frame = frame
        count = len(self._mapper.frames)
        of = "" if self._frames is None else f" of {self._frames}"
        if report is not None and report.psnr is not None:
            self._psnr = f"{report.psnr:.2f} dB"
        seconds = self._clock() - self._began - self.waited
        speed = f", {count / max(seconds, 1e-9):.2f} frames/s" if live is None else f"  \n{live.text()}"
        self._state = f"frame **{count}**{of}{speed}  \n{self._psnr}"
        self._changed()

    def on_further_step(self) -> None:
        self._changed()

    def on_step(self, stage: str, step: int, steps: int | None, psnr: float) -> None:
        of = "" if steps is None else f" of {steps}"
        self._state = f"{stage}: step **{step}**{of}  \n{psnr:.2f} dB"
        self._changed()

    def on_stage(self, stage: str) -> None:
        self._updates.put(Update(numbers=f"{stage}\n\nThe page ends with the run; `modp-ti view` shows the map."))

    # ---- the mapping thread ----------------------------------------------------------------------------------

    def _changed(self) -> None:
        """Publish what is due after a change of the map, and block while paused. Errors end the viewer, not the run."""
        if self._failed:
            return
        try:
            self._behind = True
            self.page.requests.outdate()
            self.pictures_limit.charge(self._serving.since_last())
            self._look_around()
            if self._gate.paused:
                self._hold()
        except Exception as error:
            self._give_up(error)

    def _give_up(self, error: Exception) -> None:
        if self._failed:
            return
        self._failed = True
        self._gate.pause(False)
        self._say(f"the viewer has stopped, the run goes on: {type(error).__name__}: {error}")

    def _look_around(self) -> None:
        if not len(self.page.requests):
            return
        self._visited = True
        self._settle()
        if self._clock() - self._numbers_at >= NUMBERS_EVERY and self.numbers_limit.allows():
            self._numbers_at = self._clock()
            with self.numbers_limit.measured():
                self._updates.put(self._overview())
        if self.pictures_limit.allows():
            with self.pictures_limit.measured():
                self._show_map()

    def _settle(self) -> None:
        """Set the page's units, once the first keyframe provides the scene depth."""
        store = self._mapper.pipeline.keyframes
        if len(store):
            self.page.settle(store.scene_depth, store[0].T_camera_world, store[0].camera)

    def _hold(self) -> None:
        """Block while paused. Browsers are served without a cost limit, as there is no mapping to slow down."""
        alone_since: float | None = None

        def serve() -> None:
            nonlocal alone_since
            now = self._clock()
            self._visited |= len(self.page.requests) > 0
            holder, browsers = self._gate.holder, self.page.requests
            watched = len(browsers) > 0 if holder is None else holder in browsers
            alone_since = None if watched or not self._visited else alone_since or now
            if alone_since is not None and now - alone_since > PATIENCE:
                self._gate.pause(False)
                self.page.show_paused()
            else:
                self._show_map()

        self._settle()
        self._updates.put(self._overview())
        with self.numbers_limit.suspended(), self.pictures_limit.suspended():
            self.waited += self._gate.hold(serve)
        self._serving.since_last()

    def _overview(self) -> Update:
        """Collect the numbers, the current frame, the points and the keyframes."""
        store, gaussians = self._mapper.pipeline.keyframes, self._mapper.pipeline.gaussians
        cost = 100.0 * self.cost / max(self._clock() - self._began - self.waited, 1e-9)
        paused = "  \n**paused**" if self._gate.paused else ""
        counts = f"{len(store.selected)} keyframes, {len(gaussians):,} Gaussians"
        numbers = f"{self._state}  \n{counts}  \nviewer: {cost:.1f} %{paused}"
        frame = self._frame
        if frame is None or len(store) == 0:
            return Update(numbers=numbers)
        T = store.corrected(frame.index, frame.T_camera_world)
        level = next((level for level in frame.pyramid if level.camera.width <= THUMBNAIL), frame.pyramid[-1])
        return Update(
            numbers,
            ShownFrame(T, frame.camera, level.rgba[..., :3]),
            frame.points.xyz,
            (np.stack([view.T_camera_world for view in store.selected]), store[0].camera),
        )

    def _show_map(self) -> None:
        """Publish the splats or one browser's picture, unless the publisher still holds the previous one."""
        pipeline, waiting = self._mapper.pipeline, self._updates.waiting
        if not len(self.page.requests) or len(pipeline.keyframes) == 0 or len(pipeline.gaussians) == 0:
            return
        if self.page.requests.shows(SPLATS) and self._behind and (waiting is None or waiting.splats is None):
            self._behind = False
            self._updates.put(Update(splats=pipeline.gaussians.to_numpy()))
        if waiting is None or waiting.picture is None:
            camera = self.page.requests.next(but=SPLATS)
            if camera is not None:
                self.page.attempt(camera.client, lambda: self._render(camera))

    def _render(self, browser: BrowserCamera) -> None:
        """Render the map for one browser. The publishing thread converts the result to a picture."""
        pipeline = self._mapper.pipeline
        images, store = pipeline.renderer.images, pipeline.keyframes
        size, poses = (images.width, images.height), np.stack([view.T_camera_world for view in store])

        def photograph(index: int) -> Photograph:
            k = store[index]
            return Photograph(k.rgba, k.camera, k.T_camera_world.copy(), copy(k.exposure), k.vignette)

        def render(camera: PinholeCamera, T_camera_world: NDArray[np.float64]) -> RenderedView:
            return pipeline.renderer.render(camera, T_camera_world, pipeline.near)

        largest = images.max_width, images.max_height
        try:
            depth, units = store.scene_depth, self.page.units
            paint = painter(browser, units, render, largest, depth, poses, photograph, lambda: self._depths(render))
        finally:
            images.resize(*size)  # also clears the buffers, so that the mapper's next step does not pay for it
        if paint is not None:
            self._updates.put(Update(picture=(browser.client, paint)))

    def _depths(self, render: Callable[[PinholeCamera, NDArray[np.float64]], RenderedView]) -> list[SeenDepth]:
        """Render the keyframes that are new, or have moved since, and return what all of them see."""
        store = self._mapper.pipeline.keyframes
        for view in store.selected:
            before, T = self._seen.get(view.index), view.T_camera_world
            if before is None or np.linalg.norm(before.T_camera_world - T) > STAYS * (1.0 + np.linalg.norm(T)):
                camera = view.camera.within(SIDE)
                self._seen[view.index] = SeenDepth.of(T, camera, render(camera, T))
        return list(self._seen.values())

    # ---- the publishing thread -------------------------------------------------------------------------------

    def _publish(self) -> None:
        try:
            for update in iter(self._updates.take, None):  # until it is closed
                self._show(update)
        except Exception as error:
            self._give_up(error)

    def _show(self, update: Update) -> None:
        page = self.page
        if update.numbers is not None:  # first, as they are out of date soonest
            page.show_numbers(update.numbers)
        if update.keyframes is not None:
            page.show_keyframes(*update.keyframes)
        if update.frame is not None:
            page.show_frame(update.frame)
        if update.points is not None:
            page.show_points(update.points)
        if update.splats is not None:
            page.show_splats(splats_of(update.splats, page.units, self.settings.max_splats))
        if update.picture is not None:
            client, paint = update.picture
            page.attempt(client, lambda: page.show_picture(client, paint()))
