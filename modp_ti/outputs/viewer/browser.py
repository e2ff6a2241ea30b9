"""`Browser`: the controls of one browser, and what it alone shows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from modp_ti.outputs.viewer.handover import BrowserCamera
from modp_ti.outputs.viewer.modes import SPLATS, scale_of

if TYPE_CHECKING:
    import viser

# Names of the nodes of the scene by the labels of their boxes.
KEYFRAMES, FRAME, POINTS, SPLATS_NODE = "/keyframes", "/frame", "/points", "/splats"
LABELS = {KEYFRAMES: "Keyframes", FRAME: "Current frame", POINTS: "Tracked points"}


class Browser:
    """A connected browser, with its own mode, frame, boxes and camera.

    Args:
        client: viser's handle of the browser.
        modes: Display modes to choose from. The first one is shown first.
        frames: Number of frames to choose from; 0 for no choice.

    Attributes:
        boxes: The box of each node that can be hidden.
        nodes: The nodes of this browser alone, by name.
    """

    def __init__(self, client: viser.ClientHandle, modes: Sequence[str], frames: int) -> None:
        gui = client.gui
        self.client = client
        self.frame = gui.add_slider("Frame", 0, max(frames - 1, 1), 1, 0) if frames else None
        self.mode = gui.add_dropdown("Show", tuple(modes), hint="splats: drawn by the browser; others: by our renderer")
        self._scale = gui.add_html("", visible=False)
        self._note = gui.add_markdown("")
        self.boxes = {name: gui.add_checkbox(label, initial_value=True) for name, label in LABELS.items()}
        self.look = gui.add_button("Look from the current frame")
        self.link = gui.add_button("Link to this view")
        self.nodes: dict[str, Any] = {}
        self._veils: dict[str, Any] = {}  # empty nodes that hide those of all browsers from this one

    @property
    def controls(self) -> list[Any]:
        """The controls that the browser may change."""
        return [self.mode, *self.boxes.values(), self.look, self.link, *([self.frame] if self.frame else [])]

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

    def arrange(self, inside: NDArray[np.float64] | None, reach: float) -> None:
        """Hide what this browser does not want to see, and the current frame as long as one looks from inside it.

        Args:
            inside: (3,) centre of the current frame's camera [page units], None without a frame.
            reach: Distance from there within which the frame would cover what is behind it [page units].
        """
        position = self.client.camera.position
        hidden = {name: not box.value for name, box in self.boxes.items()} | {SPLATS_NODE: self.mode.value != SPLATS}
        hidden[FRAME] |= inside is not None and float(np.linalg.norm(position - inside)) < reach
        for name, hide in hidden.items():
            own = self.nodes.get(name)
            if own is not None:
                if own.visible == hide:
                    own.visible = not hide
            elif hide and name not in self._veils:
                self._veils[name] = self.client.scene.add_frame(name, show_axes=False)
            elif not hide and name in self._veils:
                self._veils.pop(name).remove()
