"""A panorama is what the faces of a cube show; normals are the room's; other programs read depth and normals."""

from __future__ import annotations

import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3
from modp_ti.inputs.sources.image_header import read_image_header
from modp_ti.outputs.playback.camera_paths import upright
from modp_ti.outputs.playback.film import Encoding, normals, write_pictures, write_video
from modp_ti.outputs.playback.map_renderer import MapRenderer
from modp_ti.outputs.playback.panoramas import PanoramaRenderer
from tests.panoramas import equirectangular_rays
from tests.room import Room, look_at, pinhole, walk

NEAR = 0.01
WIDTH = 512
CUBE = PinholeCamera(WIDTH / 6, WIDTH / 6, WIDTH / 6, WIDTH / 6, WIDTH // 3, WIDTH // 3)
T_CAMERA_WORLD = look_at(np.array([0.2, -0.1, 0.3]), np.array([1.0, 2.0, 0.5]))


def gaussians(directions: NDArray, distance: NDArray, size: float, colours: NDArray) -> dict[str, NDArray[np.float32]]:
    """Round Gaussians in the camera's directions (N, 3), nearly opaque; `size` is relative to their distance."""
    centre = (distance[:, None] * directions - T_CAMERA_WORLD[:3, 3]) @ T_CAMERA_WORLD[:3, :3]
    count = len(centre)
    state = {
        "position": centre,
        "log_scale": np.repeat(np.log(size * distance)[:, None], 3, axis=1),
        "quaternion": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        "opacity_logit": np.full(count, 6.0),
        "sh": (colours[:, None] - 0.5) / 0.2820948,
    }
    return {name: values.astype(np.float32) for name, values in state.items()}


def around(count: int) -> NDArray[np.float64]:
    """Unit vectors that are spread evenly over the sphere."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)


def test_a_panorama_is_what_six_faces_of_a_cube_show() -> None:
    directions = around(3000)
    state = gaussians(directions, np.full(3000, 2.0), 0.04, 0.5 + 0.4 * np.sin(5 * directions))
    view = PanoramaRenderer(state, WIDTH, NEAR).view(CUBE, T_CAMERA_WORLD)
    renderer, square = MapRenderer(state, CUBE.width, CUBE.height, NEAR), []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            R = np.roll(np.eye(3), axis, axis=1) * np.array([1.0, sign, sign])[:, None]  # looks along an axis
            T = np.eye(4)
            T[:3, :3] = R
            true = renderer.view(CUBE, T @ T_CAMERA_WORLD)
            column, row = np.meshgrid(np.arange(CUBE.width) + 0.5, np.arange(CUBE.height) + 0.5)
            rays = np.dstack([(column - CUBE.cx) / CUBE.fx, (row - CUBE.cy) / CUBE.fy, np.ones_like(row)]) @ R
            x, y, z = np.moveaxis(rays, 2, 0)
            u = (0.5 + np.arctan2(x, z) / (2 * np.pi)) * WIDTH - 0.5
            v = (0.5 + np.arctan2(y, np.hypot(x, z)) / np.pi) * WIDTH / 2 - 0.5
            wrapped = np.pad(np.pad(view.colour, ((2, 2), (0, 0), (0, 0)), "edge"), ((0, 0), (2, 2), (0, 0)), "wrap")
            cut = cv2.remap(wrapped, np.float32(u + 2), np.float32(v + 2), cv2.INTER_CUBIC)
            square.append(((cut - true.colour) ** 2).mean())
    assert true.opacity.min() > 0.9
    assert -10 * np.log10(np.mean(square)) > 45


def test_things_stand_where_their_directions_say_at_their_distances() -> None:
    rays = equirectangular_rays(WIDTH // 2).reshape(-1, 3)
    chosen = np.random.default_rng(4).choice(len(rays), 40, replace=False)
    chosen = chosen[[np.sort(rays[chosen] @ ray)[-2] < 0.95 for ray in rays[chosen]]]  # alone
    distance = np.random.default_rng(5).uniform(1.0, 3.0, len(chosen))
    state = gaussians(rays[chosen], distance, 0.02, np.ones((len(chosen), 3)))
    view = PanoramaRenderer(state, WIDTH, NEAR).view(CUBE, T_CAMERA_WORLD)
    assert view.colour.shape == (WIDTH // 2, WIDTH, 3)
    depth, light = view.expected_depth().reshape(-1), view.opacity.reshape(-1)
    assert len(chosen) > 10
    for index, far in zip(chosen, distance, strict=True):
        near = rays @ rays[index] > np.cos(0.06)
        middle = light[near] @ rays[near]
        assert np.linalg.norm(np.cross(middle / np.linalg.norm(middle), rays[index])) < 0.2 * 2 * np.pi / WIDTH
        assert depth[index] == pytest.approx(far, rel=0.01)


@pytest.mark.parametrize("pitch", [-1.2, 0.0, 0.9, np.pi / 2])
def test_an_upright_camera_stays_in_its_place_and_keeps_its_heading(pitch: float) -> None:
    down, eye = np.array([0.0, 0.0, -1.0]), np.array([1.0, 2.0, 3.0])
    heading = np.array([np.cos(0.4), np.sin(0.4), 0.0])
    z = np.cos(pitch) * heading + np.sin(pitch) * down
    y = np.cos(pitch) * down - np.sin(pitch) * heading
    T = np.eye(4)
    T[:3, :3] = np.stack([np.cross(y, z), y, z])
    T[:3, 3] = -T[:3, :3] @ eye
    made = upright(T, down)
    np.testing.assert_allclose(made[:3, :3], np.stack([np.cross(down, heading), down, heading]), atol=1e-9)
    np.testing.assert_allclose(made[:3, :3] @ eye + made[:3, 3], 0.0, atol=1e-9)


# ---- depth and normals -------------------------------------------------------------------------------------------


def test_normals_are_those_of_the_room(room: Room) -> None:
    camera, T = pinhole(160, 120), walk(3)[1]
    v, u = np.mgrid[:120, :160] + 0.5
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = camera.unproject(pixels, np.ones(len(pixels)))
    t, _, true = room.cast(inverse_se3(T)[:3, 3], rays @ T[:3, :3])
    true = true @ T[:3, :3].T
    true *= -np.sign((true * rays).sum(axis=1, keepdims=True))  # towards the camera
    found = normals(rays.reshape(120, 160, 3), t.reshape(120, 160)).reshape(-1, 3)
    known = found.any(axis=1)
    assert known.mean() > 0.98
    np.testing.assert_allclose(np.linalg.norm(found[known], axis=1), 1.0)
    assert ((found * rays).sum(axis=1)[known] < 0).all()
    angle = np.degrees(np.arccos(np.clip((found * true).sum(axis=1)[known], -1, 1)))
    assert np.median(angle) < 0.1 and (angle < 5).mean() > 0.93  # but for where two surfaces meet
    holed = t.reshape(120, 160).copy()
    holed[50:60, 70:80] = 0.0
    assert not normals(rays.reshape(120, 160, 3), holed)[50:60, 70:80].any()


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("encoding", ["tiff", "exr", "png"])
def test_another_program_reads_depth_and_normals(tmp_path: Path, encoding: Encoding, channels: int) -> None:
    rng, unit = np.random.default_rng(7), 0.001
    values = rng.normal(size=(24, 36, 3))
    values /= np.linalg.norm(values, axis=2, keepdims=True)
    values = 9.0 * np.abs(values[..., 0]) if channels == 1 else values
    values[3:6] = 0.0  # unknown
    write_pictures(tmp_path / "new", [values, values[::-1]], encoding, unit)
    names = sorted(path.name for path in (tmp_path / "new").iterdir() if path.suffix != ".json")
    assert names == [f"000000.{encoding}", f"000001.{encoding}"]
    for name, true in zip(names, (values, values[::-1]), strict=True):
        if encoding == "exr":
            with av.open(str(tmp_path / "new" / name)) as file:
                (frame,) = file.decode(video=0)
            read = frame.to_ndarray().reshape(true.shape)
        else:
            read = cv2.imread(str(tmp_path / "new" / name), cv2.IMREAD_UNCHANGED)
            read = read if channels == 1 else read[..., ::-1]
        assert read.dtype == (np.uint16 if encoding == "png" else np.float32)
        bound = 1e-6
        if encoding == "png":
            known = true.reshape(24, 36, -1).any(axis=2)
            assert (read[known] > 0).all() and not read[~known].any()
            read = np.where(read > 0, unit * read if channels == 1 else (read - 32768.0) / 32767.0, 0.0)
            bound = 0.51 * (unit if channels == 1 else 1 / 32767)
        np.testing.assert_allclose(read, true, atol=bound)
    if encoding == "png" and channels == 1:
        assert json.loads((tmp_path / "new" / "unit.json").read_text()) == {"scene_units": unit}


def test_panoramas_say_that_they_are_some(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (32, 64, 3), np.uint8)
    write_pictures(tmp_path / "stills", [picture], spherical=True)
    file = tmp_path / "stills" / "000000.png"
    with file.open("rb") as opened:
        assert read_image_header(opened).panorama
    np.testing.assert_array_equal(np.asarray(Image.open(file)), picture)
    assert b'FullPanoWidthPixels="64"' in Image.open(file).info["xmp"]
    for spherical in (False, True):
        video = tmp_path / f"{spherical}.mp4"
        write_video(video, [picture] * 9, 30.0, spherical)
        with av.open(str(video)) as container:
            frames = list(container.decode(video=0))
            assert len(frames) == 9
            assert any("SPHERICAL" in str(each.type) for each in frames[0].side_data) == spherical
