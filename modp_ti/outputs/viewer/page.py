"""The web page that viser serves: its scene and its controls."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import camera_centres, inverse_se3, quaternion_from_matrix
from modp_ti.files.errors import InputError
from modp_ti.outputs.viewer.handover import BrowserCamera, Gate, Requests
from modp_ti.outputs.viewer.modes import MODES, SPLATS
from modp_ti.outputs.viewer.splats import Splats

if TYPE_CHECKING:
    import viser

__all__ = ["Page", "ShownFrame"]

TITLE = "MODP-Ti"
# Depth of the scene in page units. The world's units are arbitrary, and browsers store covariances as 16-bit floats.
DEPTH_ON_PAGE = 4.0
# Position of the initial camera behind and above the first frame [page units].
BEHIND, ABOVE = 2.0, 1.0
# Depth of the frustums of keyframes and of the current frame, and size of points [page units].
KEYFRAME_SIZE, FRAME_SIZE, POINT_SIZE = 0.12, 0.4, 0.015
KEYFRAME_COLOUR, FRAME_COLOUR, POINT_COLOUR = (90, 140, 255), (255, 120, 30), (255, 60, 60)
JPEG_QUALITY = 85
KEYFRAMES, FRAME, POINTS = "Keyframes", "Current frame", "Tracked points"
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
        choose: Called with a frame's position when the frame slider moves, None for a page without slider.
        frames: Number of frames of the slider.

    Attributes:
        requests: The pictures that browsers need.
        threads: The server's threads.

    Raises:
        InputError: If viser is not installed, or `host` is not an address of this machine.
    """

    def __init__(
        self,
        host: str,
        port: int,
        gate: Gate | None = None,
        modes: Sequence[str] = MODES,
        choose: Callable[[int], None] | None = None,
        frames: int = 0,
    ) -> None:
        try:
            import viser
        except ImportError:
            raise InputError(
                'the viewer needs viser: pip install "modp-ti[viewer]", in a checkout '
                '.venv/bin/pip install -c constraints.txt -e ".[viewer]"'
            ) from None
        _require_address(host)
        self.requests = Requests(modes[0])
        self._gate = gate
        self._units: float | None = None
        self._frame: ShownFrame | None = None
        self._nodes: dict[str, Any] = {}
        self._splats: dict[int | None, Any] = {}  # by browser, None for all
        self._lock = threading.Lock()  # nodes are changed by the publishing thread and by viser's threads
        before = set(threading.enumerate())
        with _silent():
            self._server = viser.ViserServer(host=host, port=port, label=TITLE, verbose=False)
        self.threads = [thread for thread in threading.enumerate() if thread not in before]
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{self._server.get_port()}"
        # The share button is hidden because it would route the page through a third party's server.
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.scene.world_axes.visible = False
        self._add_controls(modes, choose, frames)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)

    def close(self) -> None:
        """Stop serving the page."""
        with _silent():
            self._server.stop()

    # ---- what is shown ---------------------------------------------------------------------------------------

    @property
    def units(self) -> float:
        """Page units per world unit; 1 before `settle`."""
        return self._units or 1.0

    def settle(self, scene_depth: float, T_camera_world: NDArray[np.float64]) -> None:
        """Set the page's scale by the scene's depth [scene units], and the initial view by its pose (4, 4).

        The pose also defines the up direction. Later calls have no effect.
        """
        if self._units is not None:
            return
        self._units = DEPTH_ON_PAGE / scene_depth
        forward, up = T_camera_world[2, :3], -T_camera_world[1, :3]
        centre = inverse_se3(T_camera_world)[:3, 3] * self.units
        self._server.scene.set_up_direction(up)
        eye, target = centre - BEHIND * forward + ABOVE * up, centre + DEPTH_ON_PAGE * forward
        first = self._server.initial_camera
        first.position, first.look_at, first.up = eye, target, up
        for client in self._server.get_clients().values():
            _look(client, eye, target, up)

    def show_numbers(self, text: str) -> None:
        """Show Markdown text in the numbers panel."""
        self._numbers.content = text

    def show_splats(self, splats: Splats, client: int | None = None) -> None:
        """Replace the splats of one browser, or of all, which are visible in the splats mode."""
        note = "" if len(splats.centres) == splats.of else f"{len(splats.centres):,} of {splats.of:,} Gaussians drawn"
        if note != self._note.content:
            self._note.content = note
        values = splats.centres, splats.covariances, splats.colours, splats.opacities
        with self._lock:
            shown_by = self._server if client is None else self._server.get_clients().get(client)
            if client in self._splats:
                self._splats[client].set_gaussians(*values)
            elif shown_by is not None:
                node = shown_by.scene.add_gaussian_splats("/splats", *values)
                node.visible = self.requests.mode == SPLATS
                self._splats[client] = node

    def show_picture(self, client: int, picture: NDArray[np.uint8]) -> None:
        """Set a picture (H, W, 3) as the background of one browser."""
        with self._lock:
            handle = self._server.get_clients().get(client)
            if handle is not None and self.requests.mode != SPLATS:
                handle.scene.set_background_image(picture, format="jpeg", jpeg_quality=JPEG_QUALITY)

    def show_frame(self, frame: ShownFrame) -> None:
        """Show the current frame as a frustum with its image."""
        T_world_camera = inverse_se3(frame.T_camera_world)
        pose: dict[str, NDArray] = {
            "wxyz": quaternion_from_matrix(T_world_camera[:3, :3]),
            "position": T_world_camera[:3, 3] * self.units,
        }
        self._frame = frame
        add = partial(
            self._server.scene.add_camera_frustum,
            "/frame",
            fov=_vertical(frame.camera),
            aspect=frame.camera.width / frame.camera.height,
            scale=FRAME_SIZE,
            thickness=2.0,
            thickness_units="screen",
            color=FRAME_COLOUR,
            format="jpeg",
            jpeg_quality=JPEG_QUALITY,
        )
        self._show(FRAME, add, image=frame.picture, **pose)

    def show_keyframes(self, poses: NDArray[np.float64], camera: PinholeCamera) -> None:
        """Show keyframes, given their T_camera_world (N, 4, 4), as frustums that all have the shape of `camera`."""
        style = {"colors": KEYFRAME_COLOUR, "thickness": 1.5, "thickness_units": "screen"}
        add = partial(self._server.scene.add_line_segments, "/keyframes", **style)
        self._show(KEYFRAMES, add, points=frustum_lines(poses, camera, self.units))

    def show_points(self, xyz: NDArray[np.float64]) -> None:
        """Show tracked points (N, 3), in world coordinates."""
        style = {"colors": POINT_COLOUR, "point_size": POINT_SIZE, "point_shape": "circle", "precision": "float32"}
        add = partial(self._server.scene.add_point_cloud, "/points", **style)
        self._show(POINTS, add, points=(xyz * self.units).astype(np.float32))

    def _show(self, name: str, add: Callable[..., Any], **values: Any) -> None:
        """Set the values of a node, which `add` creates first where there is none."""
        with self._lock:
            if name not in self._nodes:
                self._nodes[name] = add(**values, visible=self._boxes[name].value)
                return
            for attribute, value in values.items():
                setattr(self._nodes[name], attribute, value)

    # ---- controls --------------------------------------------------------------------------------------------

    def _add_controls(self, modes: Sequence[str], choose: Callable[[int], None] | None, frames: int) -> None:
        gui = self._server.gui
        self._numbers = gui.add_markdown("waiting for the first frame")
        if self._gate is not None:
            self._add_gate_controls(self._gate)
        if choose is not None:
            slider = gui.add_slider("Frame", min=0, max=max(frames - 1, 1), step=1, initial_value=0)
            slider.on_update(lambda _: choose(min(int(slider.value), frames - 1)))
        mode = gui.add_dropdown("Show", tuple(modes), hint="splats: drawn by the browser; others: by our renderer")
        mode.on_update(lambda _: self._set_mode(mode.value))
        self._note = gui.add_markdown("")
        self._boxes = {name: gui.add_checkbox(name, initial_value=True) for name in (KEYFRAMES, FRAME, POINTS)}
        for box in self._boxes.values():
            box.on_update(lambda _: self._set_visible())
        look = gui.add_button("Look from the current frame")
        look.on_click(lambda event: self._look_from_frame(event.client))

    def _add_gate_controls(self, gate: Gate) -> None:
        gui = self._server.gui
        self._pause = gui.add_button("Pause", hint="pause the mapping after the current frame or step")
        step = gui.add_button("Step", hint="map one frame or take one step, then pause")
        self.show_paused()

        def press(act: Callable[[], None]) -> None:
            act()
            self.show_paused()

        self._pause.on_click(lambda _: press(lambda: gate.pause(not gate.paused)))
        step.on_click(lambda _: press(gate.step))

    def show_paused(self) -> None:
        """Set the label of the pause button, if there is one."""
        if self._gate is not None:
            self._pause.label = "Resume" if self._gate.paused else "Pause"

    def _set_mode(self, mode: str) -> None:
        with self._lock:
            self.requests.show(mode)
            for node in self._splats.values():
                node.visible = mode == SPLATS
            if mode == SPLATS:
                for client in self._server.get_clients().values():
                    client.scene.set_background_image(None)
        if self._gate is not None:
            self._gate.wake()

    def _set_visible(self) -> None:
        with self._lock:
            for name, box in self._boxes.items():
                if name in self._nodes:
                    self._nodes[name].visible = box.value

    def _connected(self, client: viser.ClientHandle) -> None:
        client.camera.on_update(lambda _: self._moved(client))
        self._moved(client)

    def _disconnected(self, client: viser.ClientHandle) -> None:
        self.requests.leave(client.client_id)
        with self._lock:
            self._splats.pop(client.client_id, None)

    def _moved(self, client: viser.ClientHandle) -> None:
        if client.client_id not in self._server.get_clients():
            return  # late message of a disconnected browser
        c = client.camera
        self.requests.look(BrowserCamera(client.client_id, c.wxyz, c.position, c.fov, c.image_width, c.image_height))
        if self._gate is not None:
            self._gate.wake()

    def _look_from_frame(self, client: viser.ClientHandle | None) -> None:
        frame = self._frame
        if client is None or frame is None:
            return
        centre = inverse_se3(frame.T_camera_world)[:3, 3] * self.units
        client.camera.fov = _vertical(frame.camera)
        _look(client, centre, centre + DEPTH_ON_PAGE * frame.T_camera_world[2, :3], -frame.T_camera_world[1, :3])


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


def _look(client: viser.ClientHandle, eye: NDArray, target: NDArray, up: NDArray) -> None:
    with client.atomic():
        client.camera.position = eye
        client.camera.look_at = target
        client.camera.up_direction = up


def _require_address(host: str) -> None:
    """Raise InputError if no port of `host` can be opened, in which case viser would wait forever."""
    try:
        family = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0][0]
        with socket.create_server((host, 0), family=family):
            pass
    except OSError as error:
        raise InputError(
            f"view.host {host}: no address of this machine ({error.strerror}); 127.0.0.1 is for this machine alone, "
            "0.0.0.0 for all that reach it"
        ) from None


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Suppress viser's own messages on the terminal."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
