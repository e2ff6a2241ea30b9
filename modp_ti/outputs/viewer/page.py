"""The web page that viser serves: its scene, its controls, and what each browser shows of them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import camera_centres, inverse_se3, quaternion_from_matrix
from modp_ti.files.errors import InputError
from modp_ti.outputs.measuring import Ruler
from modp_ti.outputs.viewer.handover import BrowserCamera, Gate, Requests
from modp_ti.outputs.viewer.modes import MODES, SPLATS, Splats, frustum_lines, scale_of
from modp_ti.outputs.viewer.tape import Tape

if TYPE_CHECKING:
    import viser

TITLE = "MODP-Ti"
# Depth of the scene in page units. The world's units are arbitrary, and browsers store covariances as 16-bit floats.
DEPTH_ON_PAGE = 4.0
# Depth of the frustums of keyframes and of the current frame, and size of points [page units].
KEYFRAME_SIZE, FRAME_SIZE, POINT_SIZE = 0.12, 0.4, 0.006
KEYFRAME_COLOUR, FRAME_COLOUR, POINT_COLOUR = (90, 140, 255), (255, 120, 30), (255, 60, 60)
JPEG = {"format": "jpeg", "jpeg_quality": 85}
# Names of the nodes of the scene, and the labels of the boxes of those that can be hidden.
KEYFRAMES, FRAME, POINTS, SPLATS_NODE = "/keyframes", "/frame", "/points", "/splats"
LABELS = {KEYFRAMES: "Keyframes", FRAME: "Current frame", POINTS: "Tracked points"}


@dataclass(frozen=True)
class ShownFrame:
    """A frame to show as a frustum.

    Attributes:
        T_camera_world: (4, 4) refined pose.
        camera: The frame's camera.
        picture: (H, W, 3) uint8 image, or None.
    """

    T_camera_world: NDArray[np.float64]
    camera: PinholeCamera
    picture: NDArray[np.uint8] | None


class Browser:
    """A connected browser, with its own mode, frame, boxes and camera.

    Args:
        client: viser's handle of the browser.
        modes: Display modes to choose from. The first one is shown first.
        frames: Number of frames to choose from; 0 for no choice.
        ruler: Measures between the browser's clicks, or None.

    Attributes:
        nodes: The nodes of this browser alone, by name.
        chosen: The frame that this browser has chosen; None while it shows that of all browsers.
    """

    def __init__(self, client: viser.ClientHandle, modes: Sequence[str], frames: int, ruler: Ruler | None) -> None:
        gui = client.gui
        self.client = client
        self.slider = gui.add_slider("Frame", 0, max(frames - 1, 1), 1, 0) if frames else None
        self.mode = gui.add_dropdown("Show", tuple(modes), hint="splats: drawn by the browser; others: by our renderer")
        self._scale = gui.add_html("", visible=False)
        self._note = gui.add_markdown("")
        self.boxes = {name: gui.add_checkbox(label, initial_value=True) for name, label in LABELS.items()}
        self.tape = Tape(client, ruler, self.note) if ruler is not None else None
        self.look = gui.add_button("Look from the current frame")
        self.link = gui.add_button("Link to this view")
        self.nodes: dict[str, Any] = {}
        self.chosen: ShownFrame | None = None
        self._veils: dict[str, Any] = {}  # empty nodes that hide those of all browsers from this one

    @property
    def controls(self) -> list[Any]:
        """The controls that the browser may change."""
        optional = [self.slider, self.tape.box if self.tape is not None else None]
        always = [self.mode, *self.boxes.values(), self.look, self.link]
        return always + [control for control in optional if control is not None]

    @property
    def camera(self) -> BrowserCamera:
        """Where the browser looks from."""
        c = self.client.camera
        mode = self.mode.value
        return BrowserCamera(self.client.client_id, c.wxyz, c.position, c.fov, c.image_width, c.image_height, mode)

    @property
    def link_to_view(self) -> str:
        """The query of the page's address that opens it with this browser's camera."""
        c = self.client.camera
        parts = {"Position": c.position, "LookAt": c.look_at, "Up": c.up_direction, "Fov": [c.fov]}
        return "?" + "&".join(f"initialCamera{k}={','.join(f'{x:.4g}' for x in part)}" for k, part in parts.items())

    def note(self, text: str) -> None:
        """Show Markdown text below the mode."""
        if text != self._note.content:
            self._note.content = text

    def scale(self, depth: float | None) -> None:
        """Show what the colours of the mode mean, given the depth of the scene [scene units]."""
        content = "" if depth is None else scale_of(self.mode.value, depth)
        if content != self._scale.content:
            self._scale.content, self._scale.visible = content, bool(content)

    def arrange(self, frame: ShownFrame | None, units: float) -> None:
        """Hide what this browser does not want to see, and the frame's picture while one looks from inside of it."""
        hidden = {name: not box.value for name, box in self.boxes.items()} | {SPLATS_NODE: self.mode.value != SPLATS}
        if frame is not None:
            inside = inverse_se3(frame.T_camera_world)[:3, 3] * units
            hidden[FRAME] |= float(np.linalg.norm(self.client.camera.position - inside)) < FRAME_SIZE
        for name, hide in hidden.items():
            if (own := self.nodes.get(name)) is not None:
                if own.visible == hide:
                    own.visible = not hide
            elif hide and name not in self._veils:
                self._veils[name] = self.client.scene.add_frame(name, show_axes=False)
            elif not hide and name in self._veils:
                self._veils.pop(name).remove()


class Page:
    """Serves the web page at `url` until `close`.

    Args:
        host: Address to listen on.
        port: Port to listen on. If it is taken, the next free one is used; 0 picks any free port.
        gate: The gate that the pause and step buttons control, None for a page without them.
        modes: Display modes to choose from. The first one is shown first.
        choose: Called with a browser's id and the frame's position that it chooses, None for a page without slider.
        frames: Number of frames of the slider.
        ruler: Measures between the clicks of browsers, None for a page without measuring.

    Attributes:
        requests: The pictures that browsers need.
        threads: The server's threads.
        url: Address of the page. Who has it can see the map.

    Raises:
        InputError: If viser is not installed, or no port can be opened at `host`.
    """

    def __init__(
        self,
        host: str,
        port: int,
        gate: Gate | None = None,
        modes: Sequence[str] = MODES,
        choose: Callable[[int, int], None] | None = None,
        frames: int = 0,
        ruler: Ruler | None = None,
    ) -> None:
        try:
            import viser  # noqa: F401

            from modp_ti.outputs.viewer.door import Door
        except ImportError:
            raise InputError(
                'the viewer needs viser: pip install "modp-ti[viewer]", in a checkout '
                '.venv/bin/pip install -c constraints.txt -e ".[viewer]"'
            ) from None
        self.requests = Requests()
        self._gate = gate
        self._modes, self._choose, self._frames, self._ruler = modes, choose, frames, ruler
        self._units: float | None = None
        self._frame: ShownFrame | None = None  # of the browsers that have chosen none
        self._nodes: dict[str, Any] = {}  # those of all browsers
        self._browsers: dict[int, Browser] = {}
        self._eyes = np.zeros((0, 3))  # of the keyframes [page units]
        self._drawn = ""  # how many of the Gaussians all browsers draw
        self._lock = threading.RLock()  # nodes are changed by the publishing thread and by viser's threads
        before = set(threading.enumerate())
        self._door = Door(host, port, TITLE, takes_clicks=ruler is not None)
        self._server = self._door.server
        self.threads = [thread for thread in threading.enumerate() if thread not in before]
        self.url = self._door.url
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.scene.world_axes.visible = False
        self._numbers = self._server.gui.add_markdown("waiting for the first frame")
        if gate is not None:
            self._add_gate_controls(gate)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)

    def close(self) -> None:
        """Stop serving the page."""
        self._door.close()

    @property
    def address(self) -> str:
        """The address for the user, who is warned if it is open to more than this machine."""
        open_to_all = "\nnote: other machines can reach this page, unencrypted; whoever has its address sees the map"
        return self.url + (open_to_all if self._door.beyond_this_machine else "")

    def attempt(self, client: int, act: Callable[[], None]) -> None:
        """Do something for one browser. What fails is noted on its page, or ends its connection, and nothing else."""
        try:
            act()
        except InputError as error:
            if client in self._browsers:
                self._browsers[client].note(str(error))
        except Exception:
            self._door.dismiss(client)

    # ---- what is shown ---------------------------------------------------------------------------------------

    @property
    def units(self) -> float:
        """Page units per world unit; 1 before `settle`."""
        return self._units or 1.0

    def settle(self, scene_depth: float, T_camera_world: NDArray[np.float64], camera: PinholeCamera) -> None:
        """Set the page's scale by the scene's depth [scene units], and the initial view by a camera.

        The pose (4, 4) also defines the up direction. Later calls have no effect.
        """
        if self._units is not None:
            return
        self._units = DEPTH_ON_PAGE / scene_depth
        self._server.scene.set_up_direction(-T_camera_world[1, :3])
        first = self._server.initial_camera
        first.position, first.look_at, first.up, first.fov = self._view(T_camera_world, camera)
        for browser in list(self._browsers.values()):
            self._look(browser.client, T_camera_world, camera)
            browser.scale(scene_depth)

    def show_numbers(self, text: str) -> None:
        """Show Markdown text in the numbers panel."""
        self._numbers.content = text

    def show_splats(self, splats: Splats, client: int | None = None) -> None:
        """Replace the splats of one browser, or of all, which are visible in the splats mode."""
        drawn = "" if len(splats.centres) == splats.of else f"{len(splats.centres):,} of {splats.of:,} Gaussians drawn"
        values = splats.centres, splats.covariances, splats.colours, splats.opacities
        with self._lock:
            self._drawn = drawn if client is None else self._drawn
            for browser in self._shown_to(client):
                browser.note(drawn)
            self._put(
                SPLATS_NODE,
                client,
                lambda scene: scene.add_gaussian_splats(SPLATS_NODE, *values),
                lambda node: node.set_gaussians(*values),
            )

    def show_picture(self, client: int, picture: NDArray[np.uint8]) -> None:
        """Set a picture (H, W, 3) as the background of one browser."""
        with self._lock:
            browser = self._browsers.get(client)
            if browser is not None and browser.mode.value != SPLATS:
                browser.client.scene.set_background_image(picture, **JPEG)

    def show_frame(self, frame: ShownFrame, client: int | None = None) -> None:
        """Show the current frame of one browser, or of all, as a frustum with its image."""
        T_world_camera = inverse_se3(frame.T_camera_world)
        if client is None:
            self._frame = frame
        elif client in self._browsers:
            self._browsers[client].chosen = frame
        style = {"scale": FRAME_SIZE, "thickness": 2.0, "thickness_units": "screen", "color": FRAME_COLOUR, **JPEG}
        shape = {"fov": _vertical(frame.camera), "aspect": frame.camera.width / frame.camera.height}
        self._show(
            lambda scene, **values: scene.add_camera_frustum(FRAME, **style, **shape, **values),
            FRAME,
            client,
            image=frame.picture,
            wxyz=quaternion_from_matrix(T_world_camera[:3, :3]),
            position=T_world_camera[:3, 3] * self.units,
        )

    def show_keyframes(self, poses: NDArray[np.float64], camera: PinholeCamera) -> None:
        """Show keyframes, given their T_camera_world (N, 4, 4), as frustums that all have the shape of `camera`."""
        style = {"colors": KEYFRAME_COLOUR, "thickness": 1.5, "thickness_units": "screen"}
        self._eyes = camera_centres(poses) * self.units
        lines = frustum_lines(poses, camera, self.units, KEYFRAME_SIZE)
        self._show(lambda scene, points: scene.add_line_segments(KEYFRAMES, points, **style), KEYFRAMES, points=lines)

    def show_points(self, xyz: NDArray[np.float64]) -> None:
        """Show tracked points (N, 3), in world coordinates, but for those that cover the view of a keyframe."""
        style = {"colors": POINT_COLOUR, "point_size": POINT_SIZE, "point_shape": "circle", "precision": "float32"}
        points = (xyz * self.units).astype(np.float32)
        for eye in self._eyes:
            points = points[np.linalg.norm(points - eye, axis=1) > FRAME_SIZE]
        self._show(lambda scene, points: scene.add_point_cloud(POINTS, points, **style), POINTS, points=points)

    def _show(self, add: Callable[..., Any], name: str, client: int | None = None, **values: Any) -> None:
        """Set the values of a node of one browser, or of all, which `add` creates first where there is none."""

        def change(node: Any) -> None:
            for attribute, value in values.items():
                setattr(node, attribute, value)

        self._put(name, client, lambda scene: add(scene, **values), change)

    def _put(self, name: str, client: int | None, add: Callable[[Any], Any], change: Callable[[Any], None]) -> None:
        """Add a node of one browser, or of all, or change it. A browser that has left gets none."""
        with self._lock:
            browser = None if client is None else self._browsers.get(client)
            if client is not None and browser is None:
                return
            nodes = self._nodes if browser is None else browser.nodes
            if name in nodes:
                change(nodes[name])
            else:
                nodes[name] = add(self._server.scene if browser is None else browser.client.scene)
            for shown_to in self._shown_to(client):
                shown_to.arrange(shown_to.chosen or self._frame, self.units)

    def _shown_to(self, client: int | None) -> list[Browser]:
        return [browser for number, browser in self._browsers.items() if client in (None, number)]

    # ---- controls --------------------------------------------------------------------------------------------

    def _add_gate_controls(self, gate: Gate) -> None:
        gui = self._server.gui
        self._pause = gui.add_button("Pause", hint="pause the mapping after the current frame or step")
        step = gui.add_button("Step", hint="map one frame or take one step, then pause")
        self._door.admit(self._pause, step)
        self.show_paused()

        def press(act: Callable[[], None]) -> None:
            act()
            self.show_paused()

        self._pause.on_click(lambda event: press(lambda: gate.pause(not gate.paused, event.client_id)))
        step.on_click(lambda event: press(lambda: gate.step(event.client_id)))

    def show_paused(self) -> None:
        """Set the label of the pause button, if there is one."""
        if self._gate is not None:
            self._pause.label = "Resume" if self._gate.paused else "Pause"

    def _connected(self, client: viser.ClientHandle) -> None:
        number = client.client_id
        browser = Browser(client, self._modes, self._frames if self._choose else 0, self._ruler)

        def on(register: Callable[[Callable[[Any], None]], Any], act: Callable[[], None]) -> None:
            register(lambda _: self.attempt(number, act))

        with self._lock:
            self._browsers[number] = browser
            browser.note(self._drawn)
        if (choose := self._choose) is not None and (slider := browser.slider) is not None:
            on(slider.on_update, lambda: choose(number, min(int(slider.value), self._frames - 1)))
            choose(number, 0)
        on(browser.mode.on_update, lambda: self._set_mode(browser))
        for box in browser.boxes.values():
            on(box.on_update, lambda: self._moved(browser))
        if (tape := browser.tape) is not None:
            on(tape.box.on_update, lambda: tape.set(self.units, lambda act: self.attempt(number, act)))
        on(browser.look.on_click, lambda: self._look_from_frame(browser))
        on(browser.link.on_click, lambda: browser.note(f"[This view]({self.url}{browser.link_to_view})"))
        on(client.camera.on_update, lambda: self._moved(browser))
        self._door.admit(*browser.controls)
        self.attempt(number, lambda: self._moved(browser))

    def _disconnected(self, client: viser.ClientHandle) -> None:
        self.requests.leave(client.client_id)
        with self._lock:
            self._browsers.pop(client.client_id, None)

    def _set_mode(self, browser: Browser) -> None:
        with self._lock:
            browser.scale(None if self._units is None else DEPTH_ON_PAGE / self._units)
            if browser.mode.value == SPLATS:
                browser.client.scene.set_background_image(None)
        self._moved(browser)

    def _moved(self, browser: Browser) -> None:
        """Take in what a browser wants to see, and from where."""
        with self._lock:
            if browser.client.client_id not in self._server.get_clients():
                return  # late message of a disconnected browser
            browser.arrange(browser.chosen or self._frame, self.units)
            self.requests.look(browser.camera)
        if self._gate is not None:
            self._gate.wake()

    def _look_from_frame(self, browser: Browser) -> None:
        if (frame := browser.chosen or self._frame) is not None:
            self._look(browser.client, frame.T_camera_world, frame.camera)

    def _look(self, client: viser.ClientHandle, T_camera_world: NDArray[np.float64], camera: PinholeCamera) -> None:
        """Move a browser's camera to a camera's place."""
        with client.atomic():
            to = client.camera
            to.position, to.look_at, to.up_direction, to.fov = self._view(T_camera_world, camera)

    def _view(self, T_camera_world: NDArray[np.float64], camera: PinholeCamera) -> tuple[Any, Any, Any, float]:
        """Return centre and target [page units], up direction and vertical field of view [rad] of a camera."""
        eye = inverse_se3(T_camera_world)[:3, 3] * self.units
        return eye, eye + DEPTH_ON_PAGE * T_camera_world[2, :3], -T_camera_world[1, :3], _vertical(camera)


def _vertical(camera: PinholeCamera) -> float:
    """Return the vertical field of view [rad]."""
    return float(2 * np.arctan(0.5 * camera.height / camera.fy))
