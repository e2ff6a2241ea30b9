"""One web page with the map, a viewer and a flight along the trajectory."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import camera_centres, exp_se3, quaternion_from_matrix
from modp_ti.files.atomic import replace_text
from modp_ti.outputs.formats.gltf import write_mesh_glb
from modp_ti.outputs.formats.sog import sog_bytes
from modp_ti.outputs.measuring import read_world
from modp_ti.outputs.playback.camera_paths import smoothed
from modp_ti.outputs.playback.finished_run import FinishedRun
from pipelines.render.spherical_harmonics import sh_rotation

if TYPE_CHECKING:
    from open3d.pybind.geometry import TriangleMesh

# Height of the eye of someone who walks in the page [m]. It is the viewer's.
EYE_HEIGHT = 1.5
# The scene's depth in the page [m], unless the map is in metres.
DEPTH = 3.0
# Weight of the cameras' y axes in the direction of gravity. It decides where the x axes leave the pitch open.
HELD = 0.01
# Duration of the flight [s] and its keyframes per second, and the deviation of its smoothing [frames].
SHORTEST, LONGEST = 4.0, 90.0
KEYS_PER_SECOND = 4
DEVIATION = 3.0
FRAME_RATE = 30
# Decimals of positions [m].
DIGITS = 4
TO_VIEWER = np.array([-1.0, -1.0, 1.0])
Y = np.array([0.0, 1.0, 0.0])
# Fields of view that the viewer accepts [degrees].
FIELDS_OF_VIEW = (10.0, 120.0)


@dataclass(frozen=True)
class Levelled:
    """A similarity that makes a map upright.

    Attributes:
        R: (3, 3) rotation from the map's frame to one with y down.
        scale: Factor on lengths.
    """

    R: NDArray[np.float64]
    scale: float

    def points(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Move points (..., 3) of the map."""
        return self.scale * xyz @ self.R.T


def level(poses: NDArray[np.float64], scene_depth: float) -> Levelled:
    """Estimate what is upright, from cameras that were held without roll.

    Down is the direction most orthogonal to the cameras' x axes. If these are nearly parallel, the mean y axis decides.

    Args:
        poses: (N, 4, 4) T_camera_world.
        scene_depth: The scene's depth [scene units].
    """
    x, y = poses[:, 0, :3], poses[:, 1, :3]
    A = x.T @ x + HELD * (len(y) * np.eye(3) - y.T @ y)
    down = np.linalg.eigh(A)[1][:, 0]
    down = down if down @ y.sum(axis=0) >= 0 else -down
    return Levelled(turning(down, Y), DEPTH / scene_depth)


def levelled(run: FinishedRun) -> Levelled:
    """Return what makes a finished map upright: its `world.json` (`modp-ti scale`), else its cameras, see `level`.

    The scale of a map in metres stays.
    """
    world, found = read_world(run.folder), level(run.poses, run.record.scene_depth)
    R = turning(np.array(world["down"]), Y) if "down" in world else found.R
    return Levelled(R, 1.0 if world.get("unit") == "m" else found.scale)


def moved(state: Mapping[str, NDArray], R: NDArray[np.float64], scale: float) -> dict[str, NDArray]:
    """Rotate Gaussians by R (3, 3) and scale them, both around the origin."""
    w, x, y, z = quaternion_from_matrix(R)
    # Product of R's quaternion with each Gaussian's, as a matrix.
    product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    M = sh_rotation(round(state["sh"].shape[1] ** 0.5) - 1, R)
    return {
        "position": scale * state["position"].astype(np.float64) @ R.T,
        "log_scale": state["log_scale"].astype(np.float64) + np.log(scale),
        "quaternion": state["quaternion"].astype(np.float64) @ product.T,
        "opacity_logit": state["opacity_logit"],
        "sh": np.einsum("kj,njc->nkc", M, state["sh"].astype(np.float64)),
    }


def viewer_settings(run: FinishedRun, levelled: Levelled) -> dict[str, Any]:
    """Return the settings of SuperSplat's viewer, version 2: the start view, and a flight along the trajectory.

    The flight takes as long as the recording. It swings back and forth, since the ends of a path are rarely near.
    """
    span = float(np.ptp(run.timestamps))
    duration = round(float(np.clip(span, SHORTEST, LONGEST)), DIGITS)
    count = round(duration * KEYS_PER_SECOND) + 1
    poses = smoothed(run.poses[run.way], count, DEVIATION)
    eyes = camera_centres(poses)
    targets = eyes + run.record.scene_depth * poses[:, 2, :3]
    position, target = ((TO_VIEWER * levelled.points(points)).round(DIGITS) for points in (eyes, targets))
    fov = _longer_side(run.cameras[run.record.keyframes[0]])
    start = {"position": position[0].tolist(), "target": target[0].tolist(), "fov": fov}
    track = {
        "name": "trajectory",
        "duration": duration,
        "frameRate": FRAME_RATE,
        "loopMode": "pingpong",
        "interpolation": "spline",
        "smoothness": 1,
        "keyframes": {
            "times": np.linspace(0.0, duration * FRAME_RATE, count).round(DIGITS).tolist(),
            "values": {"position": position.ravel().tolist(), "target": target.ravel().tolist(), "fov": [fov] * count},
        },
    }
    return {
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": False,
        "background": {"color": [0, 0, 0]},
        "postEffectSettings": {
            "sharpness": {"enabled": False, "amount": 0},
            "bloom": {"enabled": False, "intensity": 1, "blurLevel": 2},
            "grading": {"enabled": False, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
            "vignette": {"enabled": False, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
            "fringing": {"enabled": False, "intensity": 0.5},
        },
        "animTracks": [track],
        "cameras": [{"initial": start}],
        "annotations": [],
        "startMode": "animTrack",
    }


def _longer_side(camera: PinholeCamera) -> float:
    """Return the field of view [degrees] along the picture's longer side, which the viewer gives the window's."""
    ratio = max(camera.width / camera.fx, camera.height / camera.fy)
    return round(float(np.clip(np.degrees(2 * np.arctan(ratio / 2)), *FIELDS_OF_VIEW)), DIGITS)


def turning(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest rotation (3, 3) that takes the unit vector a to the unit vector b."""
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-9:
        # The same direction, or the opposite one: half a turn around the x axis, for b is y.
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return exp_se3(np.append(np.zeros(3), axis / sine * np.arctan2(sine, cosine)))[:3, :3]


def write_splat_page(
    path: str | os.PathLike[str],
    name: str,
    settings: Mapping[str, Any],
    state: Mapping[str, NDArray] | None = None,
    world: Mapping[str, Any] | None = None,
    walls: bytes | None = None,
) -> None:
    """Write a page that shows Gaussians with SuperSplat's viewer, which takes 2.1 MB.

    Args:
        path: The file.
        name: Title of the page.
        settings: The viewer's settings, see `viewer_settings`.
        state: Gaussians by name, as from `GaussianField.to_numpy`, with y down. The page holds them as `.sog` in base
            85, which takes 25 percent more than its bytes, and requests nothing: a browser opens it from the disk. None
            for a page that shows the map of the `lod-meta.json` next to it, and loads what it shows from its server.
        world: What to measure in, of a page that holds its map: `unit`, `scale` in units per page unit, its relative
            `deviation`, and the `floor`'s height in the page or None. None for a page without measuring.
        walls: What someone who walks in the map does not pass through, see `page_glb`, of a page that holds its map.
            None for a page without walking.
    """
    import jinja2
    from markupsafe import Markup

    content = b"" if state is None else sog_bytes(state)
    vendored = files("modp_ti.outputs.splat_page") / "supersplat"
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("modp_ti.outputs.splat_page", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
    )
    page = environment.get_template("page.html.j2").render(
        name=name,
        css=Markup((vendored / "viewer.min.css").read_text("utf-8")),
        js=Markup((vendored / "viewer.min.js").read_text("utf-8")),
        tools=Markup((files("modp_ti.outputs.splat_page") / "tools.js").read_text("utf-8")),
        settings=settings,
        world=world,
        map=Markup(_text(content)),
        length=len(content),
        walls=Markup(_text(walls or b"")),
    )
    replace_text(path, page)


def page_glb(mesh: TriangleMesh, upright: Levelled) -> bytes:
    """Return an Open3D TriangleMesh of the map as GLB in the axes of the page, where the map is `upright`."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "walls.glb"
        write_mesh_glb(path, TO_VIEWER * upright.points(np.asarray(mesh.vertices)), np.asarray(mesh.triangles))
        return path.read_bytes()


def _text(content: bytes) -> str:
    """Return content in base 85. Without "<", nothing in it can end an element. It has whole words of four bytes."""
    return base64.b85encode(content + bytes(-len(content) % 4)).decode("ascii").replace("<", ",")
