"""The web page that viser serves: its scene and its controls."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import camera_centres, inverse_se3, quaternion_from_matrix
from modp_ti.files.errors import InputError
from modp_ti.outputs.viewer.browser import FRAME, KEYFRAMES, POINTS, SPLATS_NODE, Browser
from modp_ti.outputs.viewer.handover import Gate, Requests
from modp_ti.outputs.viewer.modes import MODES, SPLATS, Splats

if TYPE_CHECKING:
    import viser

TITLE = "MODP-Ti"
# Depth of the scene in page units. The world's units are arbitrary, and browsers store covariances as 16-bit floats.
DEPTH_ON_PAGE = 4.0
# Depth of the frustums of keyframes and of the current frame, and size of points [page units].
KEYFRAME_SIZE, FRAME_SIZE, POINT_SIZE = 0.12, 0.4, 0.006
KEYFRAME_COLOUR, FRAME_COLOUR, POINT_COLOUR = (90, 140, 255), (255, 120, 30), (255, 60, 60)
JPEG_QUALITY = 85
# Corners of a frustum's image as (x, y) in {0, 1}.
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])


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


class Page:
    """Serves the web page at `url` until `close`.

    Args:
        host: Address to listen on.
        port: Port to listen on. If it is taken, the next free one is used; 0 picks any free port.
        gate: The gate that the pause and step buttons control, None for a page without them.
        modes: Display modes to choose from. The first one is shown first.
        choose: Called with a browser's id and the frame's position that it chooses, None for a page without slider.
        frames: Number of frames of the slider.

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
        self._modes, self._choose, self._frames = modes, choose, frames
        self._units: float | None = None
        self._frame: ShownFrame | None = None
        self._chosen: dict[int, ShownFrame] = {}  # by browser, where each chooses its own
        self._nodes: dict[str, Any] = {}  # those of all browsers
        self._browsers: dict[int, Browser] = {}
        self._eyes = np.zeros((0, 3))  # of the keyframes [page units]
        self._drawn = ""  # how many of the Gaussians all browsers draw
        self._lock = threading.RLock()  # nodes are changed by the publishing thread and by viser's threads
        before = set(threading.enumerate())
        self._door = Door(host, port, TITLE)
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
        first, up = self._server.initial_camera, -T_camera_world[1, :3]
        self._server.scene.set_up_direction(up)
        first.position, first.look_at = self._eye_and_target(T_camera_world)
        first.up, first.fov = up, _vertical(camera)
        for browser in list(self._browsers.values()):
            self._look(browser.client, T_camera_world, camera)
            browser.scale(scene_depth)

    def show_numbers(self, text: str) -> None:
        """Show Markdown text in the numbers panel."""
        self._numbers.content = text

    def show_splats(self, splats: Splats, client: int | None = None) -> None:
        """Replace the splats of one browser, or of all, which are visible in the splats mode."""
        values = splats.centres, splats.covariances, splats.colours, splats.opacities
        drawn = "" if len(splats.centres) == splats.of else f"{len(splats.centres):,} of {splats.of:,} Gaussians drawn"
        with self._lock:
            self._drawn = drawn if client is None else self._drawn
            browsers = [browser for key, browser in self._browsers.items() if client in (None, key)]
            for browser in browsers:
                browser.note(drawn)
            nodes, scene = self._scene_of(client)
            if scene is not None and SPLATS_NODE in nodes:
                nodes[SPLATS_NODE].set_gaussians(*values)
            elif scene is not None:
                nodes[SPLATS_NODE] = scene.add_gaussian_splats(SPLATS_NODE, *values)
                self._arrange(browsers)

    def show_picture(self, client: int, picture: NDArray[np.uint8]) -> None:
        """Set a picture (H, W, 3) as the background of one browser."""
        with self._lock:
            browser = self._browsers.get(client)
            if browser is not None and browser.mode.value != SPLATS:
                browser.client.scene.set_background_image(picture, format="jpeg", jpeg_quality=JPEG_QUALITY)

    def show_frame(self, frame: ShownFrame, client: int | None = None) -> None:
        """Show the current frame of one browser, or of all, as a frustum with its image."""
        T_world_camera = inverse_se3(frame.T_camera_world)
        if client is None:
            self._frame = frame
        else:
            self._chosen[client] = frame
        style = {
            "fov": _vertical(frame.camera),
            "aspect": frame.camera.width / frame.camera.height,
            "scale": FRAME_SIZE,
            "thickness": 2.0,
            "thickness_units": "screen",
            "color": FRAME_COLOUR,
            "format": "jpeg",
            "jpeg_quality": JPEG_QUALITY,
        }
        self._show(
            lambda scene, **values: scene.add_camera_frustum(FRAME, **style, **values),
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
        lines = frustum_lines(poses, camera, self.units)
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
        with self._lock:
            nodes, scene = self._scene_of(client)
            if scene is not None and name not in nodes:
                nodes[name] = add(scene, **values)
            elif scene is not None:
                for attribute, value in values.items():
                    setattr(nodes[name], attribute, value)
            self._arrange([browser for key, browser in self._browsers.items() if client in (None, key)])

    def _scene_of(self, client: int | None) -> tuple[dict[str, Any], Any]:
        """Return the nodes and the scene of one browser, or of all; the scene is None if the browser has left."""
        if client is None:
            return self._nodes, self._server.scene
        browser = self._browsers.get(client)
        return ({}, None) if browser is None else (browser.nodes, browser.client.scene)

    def _arrange(self, browsers: Iterable[Browser]) -> None:
        for browser in browsers:
            frame = self._chosen.get(browser.client.client_id, self._frame)
            centre = None if frame is None else inverse_se3(frame.T_camera_world)[:3, 3] * self.units
            browser.arrange(centre, FRAME_SIZE)

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
        browser = Browser(client, self._modes, self._frames if self._choose else 0)

        def on(register: Callable[[Callable[[Any], None]], Any], act: Callable[[], None]) -> None:
            register(lambda _: self.attempt(number, act))

        with self._lock:
            self._browsers[number] = browser
            browser.note(self._drawn)
        if (choose := self._choose) is not None and (slider := browser.frame) is not None:
            on(slider.on_update, lambda: choose(number, min(int(slider.value), self._frames - 1)))
            choose(number, 0)
        on(browser.mode.on_update, lambda: self._set_mode(browser))
        for box in browser.boxes.values():
            on(box.on_update, lambda: self._moved(browser))
        on(browser.look.on_click, lambda: self._look_from_frame(client))
        on(browser.link.on_click, lambda: browser.note(f"[This view]({self.url}{browser.link_to_view})"))
        on(client.camera.on_update, lambda: self._moved(browser))
        self._door.admit(*browser.controls)
        self.attempt(number, lambda: self._moved(browser))

    def _disconnected(self, client: viser.ClientHandle) -> None:
        self.requests.leave(client.client_id)
        with self._lock:
            self._browsers.pop(client.client_id, None)
            self._chosen.pop(client.client_id, None)

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
            self._arrange([browser])
            self.requests.look(browser.camera)
        if self._gate is not None:
            self._gate.wake()

    def _look_from_frame(self, client: viser.ClientHandle) -> None:
        frame = self._chosen.get(client.client_id, self._frame)
        if frame is not None:
            self._look(client, frame.T_camera_world, frame.camera)

    def _look(self, client: viser.ClientHandle, T_camera_world: NDArray[np.float64], camera: PinholeCamera) -> None:
        """Move a browser's camera to a camera's place."""
        with client.atomic():
            client.camera.fov = _vertical(camera)
            client.camera.position, client.camera.look_at = self._eye_and_target(T_camera_world)
            client.camera.up_direction = -T_camera_world[1, :3]

    def _eye_and_target(self, T_camera_world: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return centre and target of a camera with this pose (4, 4) [page units]."""
        eye = inverse_se3(T_camera_world)[:3, 3] * self.units
        return eye, eye + DEPTH_ON_PAGE * T_camera_world[2, :3]


def frustum_lines(poses: NDArray[np.float64], camera: PinholeCamera, units: float) -> NDArray[np.float32]:
    """Return the edges (8 N, 2, 3) of camera frustums in page units, for T_camera_world (N, 4, 4)."""
    size = np.array([camera.width, camera.height])
    corners = camera.unproject(CORNERS * size, np.full(4, KEYFRAME_SIZE))
    R = poses[:, :3, :3]
    centres = camera_centres(poses) * units
    ends = centres[:, None] + np.einsum("nji,kj->nki", R, corners)
    sides = np.stack([np.broadcast_to(centres[:, None], ends.shape), ends], axis=2)
    around = np.stack([ends, np.roll(ends, -1, axis=1)], axis=2)
    return np.concatenate([sides, around], axis=1).reshape(-1, 2, 3).astype(np.float32)


def _vertical(camera: PinholeCamera) -> float:
    """Return the vertical field of view [rad]."""
    return float(2 * np.arctan(0.5 * camera.height / camera.fy))
