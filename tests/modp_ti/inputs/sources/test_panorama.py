"""Faces of panoramas: against closed forms of the projections, and against faces rendered directly."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from fields.geometry.camera import PinholeCamera
from modp_ti.config.bare_recording import recorded_scene
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import is_panoramic, open_source, require_pinhole
from modp_ti.inputs.source_settings import PanoramaSettings, SourceSettings
from modp_ti.inputs.sources.panorama import Projection, faces_of, looks_panoramic, projection_of
from tests.panoramas import equirectangular_rays, fisheye_rays

LENS_FOV = 200.0


def rays_of(projection: str, height: int) -> NDArray[np.float64]:
    return equirectangular_rays(height) if projection == "equirectangular" else fisheye_rays(height, LENS_FOV)


def painted(rays: NDArray[np.float64]) -> NDArray[np.uint8]:
    """A smooth picture of the directions (..., 3), the same for every projection; black where a ray is NaN."""
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    waves = np.sin(unit @ np.array([[5.0, 2.0, 1.0], [-3.0, 6.0, 2.0], [2.0, -1.0, 7.0]]).T + (0.3, 1.1, 2.0))
    return np.rint(np.nan_to_num(127.5 + 127.5 * waves)).astype(np.uint8)


def settings(projection: str, **keys: object) -> PanoramaSettings:
    return PanoramaSettings.model_validate({"projection": projection, "lens_fov": LENS_FOV, **keys})


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two equirectangular images of 256x128."""
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), painted(equirectangular_rays(128))[..., ::-1])
    return tmp_path


@pytest.mark.parametrize("projection", ["equirectangular", "dual_fisheye"])
def test_a_pixel_is_where_the_closed_form_sends_its_ray(projection: str) -> None:
    rays = rays_of(projection, 64)
    found = projection_of(settings(projection), 128, 64, "").pixels(rays)
    x, y = np.meshgrid(np.arange(128) + 0.5, np.arange(64) + 0.5)
    # Where both lenses see a ray, the one that looks its way is taken.
    taken = np.isfinite(rays).all(axis=-1)
    if projection == "dual_fisheye":
        taken &= (rays[..., 2] >= 0) == (x < 64)
    np.testing.assert_allclose(found[taken], np.stack([x, y], axis=-1)[taken], atol=1e-9)


def test_images_without_a_camera_that_see_all_round_are_found(folder: Path, tmp_path: Path) -> None:
    first = open_source(SourceSettings(path=folder))
    with pytest.raises(InputError, match=r"source\.panorama"):
        require_pinhole(first, SourceSettings(path=folder), "a.png")
    insisted = SourceSettings.model_validate({"path": folder, "panorama": {"projection": "none"}})
    require_pinhole(first, insisted, "a.png")
    assert recorded_scene(folder).source.panorama.projection == "equirectangular"
    assert not recorded_scene(folder, ["source.panorama.projection=none"]).source.panorama.given


def test_gpano_says_that_an_image_sees_all_round(tmp_path: Path) -> None:
    """Of noise, which does not look so."""
    noise = Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 128, 3), dtype=np.uint8))
    xmp = b'<rdf:Description GPano:ProjectionType="equirectangular"/>'
    noise.save(tmp_path / "said.jpg", xmp=xmp)
    noise.save(tmp_path / "unsaid.jpg")
    images = open_source(SourceSettings(path=tmp_path))
    assert [is_panoramic(images, name) for name in ("said.jpg", "unsaid.jpg")] == [True, False]


@pytest.mark.parametrize("angle", range(0, 360, 40))
def test_a_pinhole_image_of_twice_its_height_is_none(angle: int) -> None:
    """Also one with a black border."""
    whole = painted(equirectangular_rays(256))
    view = np.roll(whole, angle, axis=1)[64:192, :256]
    assert not looks_panoramic(view)
    assert not looks_panoramic(cv2.copyMakeBorder(view, 4, 4, 8, 8, cv2.BORDER_CONSTANT))
    assert looks_panoramic(np.roll(whole, angle, axis=1))


def test_directions_lie_where_a_viewer_of_the_panorama_expects_them() -> None:
    forward, right, up = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 1e-9]
    whole = Projection(400, 200).pixels(np.array([forward, right, up]))
    np.testing.assert_allclose(whole, [[200, 100], [300, 100], [200, 0]], atol=1e-5)
    circles = Projection(400, 200, np.pi).pixels(np.array([forward, [0, 0, -1.0], [0.1, 0, 1], [0.1, 0, -1]]))
    np.testing.assert_allclose(circles[:2], [[100, 100], [300, 100]])
    assert circles[2, 0] > 100 and circles[3, 0] < 300  # the lens that looks backward has the right on its left


def test_faces_share_a_centre_look_round_and_overlap_as_told() -> None:
    faces = faces_of(settings("equirectangular", faces=5, fov=90, up_down=True), Projection(512, 256))
    axes = np.array([face.T_face_rig[2, :3] for face in faces])
    angles = 2 * np.pi * np.arange(5) / 5
    np.testing.assert_allclose(axes[:5], np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1), atol=1e-12)
    np.testing.assert_allclose(axes[5:], [[0, -1, 0], [0, 1, 0]], atol=1e-12)
    for face in faces:
        R = face.T_face_rig[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0
        assert not face.T_face_rig[:3, 3].any()
        corner = face.rays()[face.camera.height // 2 - 1, [0, -1]]
        corner /= np.linalg.norm(corner, axis=1, keepdims=True)
        across = np.degrees(np.arccos(corner[0] @ corner[1]))
        assert 89 < across < 90  # between the centres of the outermost pixels
    assert all(face.T_face_rig[1, 1] > 0.99 for face in faces[:5])  # upright


@pytest.mark.parametrize("projection", ["equirectangular", "dual_fisheye"])
def test_a_face_is_the_picture_that_its_camera_would_take(tmp_path: Path, projection: str) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), painted(rays_of(projection, 256))[..., ::-1])
    wanted = settings(projection, faces=3, fov=110, up_down=True)
    source = SourceSettings.model_validate({"path": tmp_path, "panorama": wanted.model_dump()})
    images = open_source(source)
    faces = faces_of(wanted, projection_of(wanted, 512, 256, ""))
    assert len(images) == len(faces) == 5
    for name, face in zip(images.names, faces, strict=True):
        assert images.valid(name) is None
        error = images.read(name).astype(float) - painted(face.rays())
        if projection == "dual_fisheye":  # where both lenses meet, the filter reaches beyond the one that is taken
            error = error[np.abs(face.rays()[..., 2]) > 0.05]
        assert np.abs(error).max() <= 3.0, name


def test_what_no_lens_sees_is_not_valid(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), painted(fisheye_rays(64, 160.0)))
    panorama = {"projection": "dual_fisheye", "lens_fov": 160, "faces": 4}
    images = open_source(SourceSettings.model_validate({"path": tmp_path, "panorama": panorama}))
    aside = images.valid(images.names[1])
    assert aside is not None and not aside[:, aside.shape[1] // 2].any()
    assert aside[aside.shape[0] // 2, [0, -1]].all()


def test_faces_are_images_of_one_time_and_keep_the_panoramas_order(folder: Path) -> None:
    source = {"path": folder, "fps": 10, "panorama": {"projection": "equirectangular", "faces": 3}}
    images = open_source(SourceSettings.model_validate(source))
    assert list(images.names) == [f"{stem}-face{i}.png" for stem in "ab" for i in range(3)]
    assert [images.timestamp(name) for name in images.names] == [0.0] * 3 + [0.1] * 3
    assert images.selected(1, None, 1) == images.views("b.png")
    assert images.intrinsics is not None
    camera = images.intrinsics.camera
    assert isinstance(camera, PinholeCamera)
    assert images.size(images.names[0]) == (camera.width, camera.height) == images.read(images.names[0]).shape[1::-1]


def test_panoramas_have_their_shape_and_one_size(folder: Path) -> None:
    source = SourceSettings.model_validate({"path": folder, "panorama": {"projection": "equirectangular"}})
    cv2.imwrite(str(folder / "b.png"), np.zeros((64, 128, 3), np.uint8))
    images = open_source(source)
    with pytest.raises(InputError, match=r"b.png is 128x64, the first panorama 256x128: all panoramas .* one size"):
        images.read("b-face0.png")
    (folder / "a.png").write_bytes(b"no image")
    assert open_source(source).size("a-face0.png") == (48, 48)
    cv2.imwrite(str(folder / "a.png"), np.zeros((64, 96, 3), np.uint8))
    with pytest.raises(InputError, match=r"a.png is 96x64: a panorama is twice as wide as high"):
        open_source(source)
