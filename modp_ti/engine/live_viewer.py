"""`LiveViewer`: looks on while a map grows, and shows it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.config.settings import ViewSettings
from modp_ti.engine.mapper import Mapper
from modp_ti.outputs.viewer.budget import CostLimit, ThreadClock
from modp_ti.outputs.viewer.handover import BrowserCamera, Gate, Latest
from modp_ti.outputs.viewer.modes import (
    SPLATS,
    Photograph,
    error_picture,
    nearest_photograph,
    picture_of,
    pinhole_of,
)
from modp_ti.outputs.viewer.page import Page, ShownFrame
from modp_ti.outputs.viewer.splats import splats_of
from pipelines.pipeline import FrameReport

__all__ = ["LiveViewer"]

# Of what the viewer may cost, this share is planned with: what its threads take from the mapper by turns of Python's
# lock and by crowding the caches is not measured.
PLANNED = 0.7
# Of that, this share is for the numbers and the current frame, which are cheap; the rest is for pictures and splats.
FOR_NUMBERS = 0.25
# Least seconds between two updates of the numbers.
NUMBERS_EVERY = 0.1
# Width of the current frame's picture [px], of about that.
THUMBNAIL = 320
# Seconds for which a paused run waits for a browser to come back before it goes on.
PATIENCE = 10.0


@dataclass(frozen=True)
class Update:
    """What is to be shown; None leaves a part as it is. Everything is on the host, and nobody else changes it.

    The last three are finished by the publishing thread. picture: of which browser.
    """

    numbers: str | None = None
    frame: ShownFrame | None = None
    points: NDArray[np.float64] | None = None
    keyframes: tuple[NDArray[np.float64], PinholeCamera] | None = None
    splats: dict[str, NDArray] | None = None
    picture: tuple[int, Callable[[], NDArray[np.uint8]]] | None = None

    def over(self, waiting: Update) -> Update:
        """This, with what only `waiting` has."""
        return Update(
            *(
                getattr(waiting, part.name) if getattr(self, part.name) is None else getattr(self, part.name)
                for part in fields(self)
            )
        )


class LiveViewer:
    """An `Observer` with a page in the browser. It never waits for a browser, and keeps its cost below a share.

    The mapping thread alone touches the map: between frames and steps, and at most as often as the cost allows, it
    renders what a browser asks for and copies what is shown. A thread of the viewer makes pictures and messages of it,
    viser's threads send them. say: called with a line where the viewer has to give up, which the run outlives.

    Raises InputError where the page cannot be served.
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
        self._mapper: Mapper | None = None
        self._frame: TrackedFrame | None = None
        self._state = self._psnr = ""
        self._frames: int | None = None
        self._began = clock()
        self._numbers_at = -np.inf
        self._visited = False  # by a browser, so far
        self._behind = True  # the splats on the page are not those of the map
        self._failed = False

    def close(self) -> None:
        """Serve no longer."""
        self._updates.close()
        self._publisher.join(timeout=5.0)
        self.page.close()

    @property
    def cost(self) -> float:
        """Seconds so far: of the mapping thread, and of the viewer's threads on a processor."""
        return self.numbers_limit.cost + self.pictures_limit.cost

    # ---- the observer ----------------------------------------------------------------------------------------

    def begin(self, mapper: Mapper, frames: int | None) -> None:
        self._mapper, self._frames = mapper, frames
        self._began = self._clock()
        self._serving.since_last()  # browsers that came before took nothing from the mapping

    def on_frame(self, frame: TrackedFrame, report: FrameReport | None) -> None:
        self._frame = frame
        count = len(self._mapper.frames)
        of = "" if self._frames is None else f" of {self._frames}"
        if report is not None and report.psnr is not None:
            self._psnr = f"{report.psnr:.2f} dB"
        seconds = self._clock() - self._began - self.waited
        self._state = f"frame **{count}**{of}, {count / max(seconds, 1e-9):.2f} frames/s  \n{self._psnr}"
        self._changed()

    def on_step(self, stage: str, step: int, steps: int, psnr: float) -> None:
        self._state = f"{stage}: step **{step}** of {steps}  \n{psnr:.2f} dB"
        self._changed()

    def on_stage(self, stage: str) -> None:
        self._updates.put(Update(numbers=f"{stage}\n\nThe page ends with the run; `modp-ti view` shows the map."))

    # ---- the mapping thread ----------------------------------------------------------------------------------

    def _changed(self) -> None:
        """The map has changed: show what is due, and hold while paused. Whatever fails ends the viewer, not the run."""
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
        """Give the page its units, once there is a keyframe to tell them."""
        store = self._mapper.pipeline.keyframes
        if len(store):
            self.page.settle(store.scene_depth, store[0].T_camera_world)

    def _hold(self) -> None:
        """Wait at the gate. Browsers are served at once: there is no mapping to be slowed."""
        alone_since: float | None = None

        def serve() -> None:
            nonlocal alone_since
            now = self._clock()
            self._visited |= len(self.page.requests) > 0
            alone_since = None if len(self.page.requests) or not self._visited else alone_since or now
            if alone_since is not None and now - alone_since > PATIENCE:
                self._gate.pause(False)
                self.page.show_paused(False)
            else:
                self._show_map()

        self._settle()
        self._updates.put(self._overview())
        with self.numbers_limit.suspended(), self.pictures_limit.suspended():
            self.waited += self._gate.hold(serve)
        self._serving.since_last()

    def _overview(self) -> Update:
        """Numbers, current frame, points and keyframes."""
        store, gaussians = self._mapper.pipeline.keyframes, self._mapper.pipeline.gaussians
        cost = 100.0 * self.cost / max(self._clock() - self._began - self.waited, 1e-9)
        paused = "  \n**paused**" if self._gate.paused else ""
        numbers = (
            f"{self._state}  \n{len(store)} keyframes, {len(gaussians):,} Gaussians  \nviewer: {cost:.1f} %{paused}"
        )
        frame = self._frame
        if frame is None or len(store) == 0:
            return Update(numbers=numbers)
        T = store.corrected(frame.index, frame.T_camera_world)
        level = next((level for level in frame.pyramid if level.camera.width <= THUMBNAIL), frame.pyramid[-1])
        return Update(
            numbers,
            ShownFrame(T, frame.camera, level.rgba[..., :3]),
            frame.points.xyz,
            (np.stack([view.T_camera_world for view in store]), store[0].camera),
        )

    def _show_map(self) -> None:
        """The splats, or the picture that one browser waits for, unless the publisher is not done with the last."""
        pipeline, waiting = self._mapper.pipeline, self._updates.waiting
        if not len(self.page.requests) or len(pipeline.keyframes) == 0 or len(pipeline.gaussians) == 0:
            return
        if self.page.requests.mode == SPLATS:
            if self._behind and (waiting is None or waiting.splats is None):
                self._behind = False
                self._updates.put(Update(splats=pipeline.gaussians.to_numpy()))
        elif waiting is None or waiting.picture is None:
            camera = self.page.requests.next()
            if camera is not None:
                self._render(camera, self.page.requests.mode)

    def _render(self, browser: BrowserCamera, mode: str) -> None:
        """Render for a browser; the publisher makes a picture of it."""
        pipeline = self._mapper.pipeline
        images, store = pipeline.renderer.images, pipeline.keyframes
        seen_from = pinhole_of(browser, self.page.units, images.max_width, images.max_height)
        if seen_from is None:
            return
        camera, T = seen_from
        size = images.width, images.height
        try:
            view = self._mapper.render(camera, T)
            finish = partial(picture_of, view, mode, store.scene_depth)
            if mode == "error":
                j = nearest_photograph(np.stack([view.T_camera_world for view in store]), T, store.scene_depth)
                k = store[j]
                photograph = Photograph(k.rgba, k.camera, k.T_camera_world.copy(), copy(k.exposure), k.vignette)
                seen = self._mapper.render(k.camera, k.T_camera_world)
                finish = partial(error_picture, view, camera, T, photograph, seen)
        except ValueError:
            return  # from amidst large Gaussians there is more to draw than there is room for
        finally:
            images.resize(*size)  # which clears the buffers: no cost for the mapper's next step
        self._updates.put(Update(picture=(browser.client, finish)))

    # ---- the publishing thread -------------------------------------------------------------------------------

    def _publish(self) -> None:
        while not self._updates.closed:
            update = self._updates.take()
            if update is None:
                continue
            try:
                self._show(update)
            except Exception as error:
                self._give_up(error)
                return

    def _show(self, update: Update) -> None:
        page = self.page
        if update.keyframes is not None:
            page.show_keyframes(*update.keyframes)
        if update.frame is not None:
            page.show_frame(update.frame)
        if update.points is not None:
            page.show_points(update.points)
        if update.splats is not None:
            page.show_splats(splats_of(update.splats, page.units, self.settings.max_splats))
        if update.picture is not None:
            client, finish = update.picture
            page.show_picture(client, finish())
        if update.numbers is not None:
            page.show_numbers(update.numbers)
