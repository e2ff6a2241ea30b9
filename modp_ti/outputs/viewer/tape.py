"""`Tape`: what a browser measures by clicking at the map."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from modp_ti.outputs.measuring import Ruler, SurfacePoint

if TYPE_CHECKING:
    import viser

NODE, COLOUR = "/measured", (80, 255, 80)
POINT_SIZE = 0.015  # [page units]


class Tape:
    """Measures between the points at which a browser clicks while its box is checked.

    Args:
        client: viser's handle of the browser.
        ruler: Finds the points, and says what they span.
        note: Shows a text to the browser.

    Attributes:
        box: The box that starts and ends measuring. Whoever handles it calls `set`.
        points: The points so far.
    """

    def __init__(self, client: viser.ClientHandle, ruler: Ruler, note: Callable[[str], None]) -> None:
        self.box = client.gui.add_checkbox("Measure", False, hint="click at two points or more")
        self.points: list[SurfacePoint] = []
        self._client, self._ruler, self._note = client, ruler, note

    def set(self, units: float, attempt: Callable[[Callable[[], None]], None]) -> None:
        """Begin to measure or, if the box is not checked, end and forget the points.

        Args:
            units: Page units per world unit.
            attempt: Calls a function that handles a click.
        """
        scene = self._client.scene
        scene.remove_click_callback()
        if self.box.value:
            scene.on_click()(lambda event: attempt(lambda: self._clicked(event, units)))
        else:
            self.points = []
            scene.remove_by_name(NODE)
            self._note("")

    def _clicked(self, event: viser.SceneClickEvent, units: float) -> None:
        camera = self._client.camera
        pixel = camera.fov / max(camera.image_height, 1)
        found = self._ruler.point(np.array(event.ray_origin) / units, np.array(event.ray_direction), pixel)
        if found is None:
            self._note("there is no surface of the map")
            return
        self.points.append(found)
        self._show(units)

    def _show(self, units: float) -> None:
        """Show the points, the lines between them, the last one's length, and what all of them span."""
        scene: Any = self._client.scene
        xyz = np.stack([point.xyz for point in self.points]) * units
        scene.add_point_cloud(NODE, xyz, COLOUR, point_size=POINT_SIZE, point_shape="circle", precision="float32")
        if len(xyz) > 1:
            lines = np.stack([xyz[:-1], xyz[1:]], axis=1)
            scene.add_line_segments(f"{NODE}/lines", lines, COLOUR, thickness=2.0, thickness_units="screen")
            scene.add_label(f"{NODE}/label", self._ruler.text(self.points[-2:]), position=xyz[-1])
        self._note(self._ruler.text(self.points))
