"""`modp-ti cameras`: lists the cameras that `modp-ti run --stream NUMBER` can open."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

from modp_ti.commands.shared import AsJson, Quiet, examples, one_line, outcome, progress_console

if TYPE_CHECKING:
    from modp_ti.inputs.sources.cameras import Camera

EXAMPLES = examples("modp-ti cameras", "modp-ti cameras --json")

NONE = "no camera found; a stream can be named by its address: modp-ti run --stream rtsp://HOST/PATH"


def cameras(quiet: Quiet = False, as_json: AsJson = False) -> None:
    """List the cameras of this machine: number, name, image size and rate. Each is opened for a moment."""
    with outcome(as_json) as result:
        # Imported here, so that `--help` does not wait for the readers to load.
        from modp_ti.inputs.sources.cameras import find_cameras
        from modp_ti.outputs.progress import ProgressLine

        with ProgressLine(progress_console(quiet)).working("opening the cameras"):
            found = find_cameras()
        result.text = "\n".join(map(_line, found)) or NONE
        result.data = {"cameras": [asdict(camera) for camera in found]}


def _line(camera: Camera) -> str:
    """Describe a camera: `0  HD Webcam, 640x480, 30 a second`."""
    facts = [one_line(camera.name)] if camera.name else []
    if not camera.opens:
        facts.append("cannot be opened: in use by another program, or not permitted")
    if camera.width is not None:
        facts.append(f"{camera.width}x{camera.height}")
    if camera.fps is not None:
        facts.append(f"{camera.fps:g} a second")
    return f"{camera.number}  {', '.join(facts) or 'opens'}"
