"""The page of a finished map: what a browser gets from where a frame was taken, and how the command fails."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

from fields.geometry.camera import PinholeCamera
from fields.geometry.se3 import inverse_se3, quaternion_from_matrix
from modp_ti.commands.app import app
from modp_ti.config.settings import ViewSettings
from modp_ti.outputs.formats.run_files import FramesRecord
from modp_ti.outputs.formats.splats_ply import write_splats
from modp_ti.outputs.playback.finished_run import FinishedRun, open_splats
from modp_ti.outputs.playback.map_renderer import MapRenderer
from modp_ti.outputs.viewer.finished import FinishedViewer
from modp_ti.outputs.viewer.handover import BrowserCamera
from modp_ti.outputs.viewer.modes import MODES, UNSEEN, Splats

pytestmark = pytest.mark.slow

CAMERA = PinholeCamera(90.0, 90.0, 48.0, 32.0, 96, 64)
NAMES = ["a.png", "b.png", "c.png"]


def wall() -> dict[str, np.ndarray]:
    """Gaussians close together on the plane z = 2, of many colours."""
    rng = np.random.default_rng(2)
    x, y = np.meshgrid(np.linspace(-1.6, 1.6, 60), np.linspace(-1.2, 1.2, 45))
    n = x.size
    return {
        "position": np.stack([x.ravel(), y.ravel(), np.full(n, 2.0)], axis=1).astype(np.float32),
        "log_scale": np.tile(np.float32(np.log([0.05, 0.05, 0.002])), (n, 1)),
        "quaternion": np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        "opacity_logit": np.full(n, 3.0, dtype=np.float32),
        "sh": rng.normal(0, 0.6, (n, 1, 3)).astype(np.float32),
    }


@pytest.fixture
def run(tmp_path: Path) -> FinishedRun:
    """Three frames of the wall, from three places; of the last the image is brighter by 0.1."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, -0.5, 0.5]
    write_splats(tmp_path / "splats.ply", wall())
    model = pycolmap.Reconstruction()
    model.add_point3D([0.5, 0.25, 2.0], pycolmap.Track())
    (tmp_path / "colmap").mkdir()
    model.write_binary(str(tmp_path / "colmap"))
    renderer = MapRenderer(wall(), 96, 64, 0.01)
    (tmp_path / "colmap" / "images").mkdir()
    for i, name in enumerate(NAMES):
        picture = np.clip(renderer.view(CAMERA, poses[i]).colour + (0.1 if i == 2 else 0.0), 0, 1)
        cv2.imwrite(str(tmp_path / "colmap" / "images" / name), np.round(255 * picture[..., ::-1]))
    return FinishedRun(tmp_path, NAMES, np.arange(3.0), poses, [CAMERA] * 3, FramesRecord(0.01, 2.0, [0, 2], []))


def looks(viewer: FinishedViewer, T: np.ndarray, width: int, height: int, mode: str = "splats") -> None:
    """A browser looks from T_camera_world, with the camera's field of view."""
    T_world_camera = inverse_se3(T)
    q = quaternion_from_matrix(T_world_camera[:3, :3])
    fov = 2 * np.arctan(CAMERA.height / 2 / CAMERA.fy)
    position = T_world_camera[:3, 3] * viewer.page.units
    viewer.page.requests.look(BrowserCamera(5, q, position, fov, width, height, mode))


def test_a_browser_at_a_frames_place_gets_the_frames_picture_in_every_mode(run: FinishedRun):
    viewer = FinishedViewer(run, ViewSettings(port=0), "cpu")
    got: dict[str, np.ndarray] = {}
    asked: list[str] = []
    viewer.page.show_picture = lambda client, picture: got.setdefault(asked[-1], picture)
    try:
        for mode in MODES[1:]:
            asked.append(mode)
            looks(viewer, run.poses[2], 96, 64, mode)
            viewer.serve(lambda mode=mode: mode in got)
        image = cv2.imread(str(run.folder / "colmap" / "images" / "c.png"))[..., ::-1].astype(float)
        unclipped = (image < 255) & (got["colour"] > 0)
        assert unclipped.mean() > 0.5
        np.testing.assert_allclose((image - got["colour"])[unclipped], 25.5, atol=1.01)
        # 0.1 of 0.25, in the colours of the error; where the image is clipped it is less.
        expected = cv2.applyColorMap(np.full((1, 1), 102, np.uint8), cv2.COLORMAP_TURBO)[0, 0, ::-1]
        plain = unclipped.all(axis=2)
        assert np.abs(got["error"][plain] - expected.astype(int)).max() <= 12
        assert not (got["error"] == UNSEEN).all(axis=2)[1:-1, 1:-1].any()
        assert np.ptp(got["depth"].reshape(-1, 3), axis=0).max() <= 12  # one plane, one depth
        assert got["opacity"].min() > 230
    finally:
        viewer.close()


def test_a_file_of_splats_is_shown_without_a_run(tmp_path: Path):
    write_splats(tmp_path / "wall.ply", wall())
    run = open_splats(tmp_path / "wall.ply")
    viewer = FinishedViewer(run, ViewSettings(port=0), "cpu")
    got: list[np.ndarray] = []
    viewer.page.show_picture = lambda client, picture: got.append(picture)
    try:
        looks(viewer, run.poses[0], 96, 64, "opacity")
        viewer.serve(lambda: bool(got))
    finally:
        viewer.close()
    assert (got[0].max(axis=2) > 128).mean() > 0.9  # the wall fills this narrow view


def test_a_browser_gets_the_splats_of_a_large_map_for_its_camera(tmp_path: Path):
    write_splats(tmp_path / "wall.ply", wall())
    run = open_splats(tmp_path / "wall.ply")
    viewer = FinishedViewer(run, ViewSettings(port=0, max_splats=1000), "cpu")
    got: list[tuple[int | None, Splats]] = []
    viewer.page.show_splats = lambda splats, client=None: got.append((client, splats))
    near, aside = np.eye(4), np.eye(4)
    near[:3, 3], aside[:3, 3] = [1.4, 0.0, -1.5], [-1.4, 0.0, -1.5]  # half a unit before one end, and the other
    try:
        for T, count in ((near, 1), (near, 1), (aside, 2)):
            looks(viewer, T, 96, 64)
            turns = iter(range(3))
            viewer.serve(lambda turns=turns: next(turns, None) is None)
            assert len(got) == count
    finally:
        viewer.close()
    assert all(client == 5 and splats.of == 2700 and 300 < len(splats.centres) <= 1000 for client, splats in got)
    # Each has its own end of the wall, which the camera in (-1.4, 0, 1.5) sees to the left, in full detail.
    left, right = (splats.centres[:, 0] / viewer.page.units for _, splats in got)
    assert (left < -1.2).sum() > 2 * (left > 1.2).sum() and (right > 1.2).sum() > 2 * (right < -1.2).sum()


def test_the_chosen_frame_is_shown_with_its_picture(run: FinishedRun):
    viewer = FinishedViewer(run, ViewSettings(port=0), "cpu")
    shown = []
    viewer.page.show_frame = lambda frame, client: shown.append((frame, client))
    try:
        for client, index in ((5, 0), (6, 2), (5, 1)):
            viewer.choose(client, index)
        viewer.serve(lambda: len(shown) > 0)
        assert sorted(client for _, client in shown) == [5, 6]
        for frame, client in shown:
            index = {5: 1, 6: 2}[client]
            np.testing.assert_array_equal(frame.T_camera_world, run.poses[index])
            image = cv2.imread(str(run.folder / "colmap" / "images" / NAMES[index]))[..., ::-1]
            np.testing.assert_array_equal(frame.picture, image)
    finally:
        viewer.close()


def test_an_image_that_is_gone_ends_nothing(run: FinishedRun):
    viewer = FinishedViewer(run, ViewSettings(port=0), "cpu")
    got: list[np.ndarray] = []
    viewer.page.show_picture = lambda client, picture: got.append(picture)
    (run.folder / "colmap" / "images" / "c.png").unlink()
    try:
        viewer.choose(5, 2)
        for mode in ("error", "colour"):
            looks(viewer, run.poses[2], 96, 64, mode)
            turns = iter(range(3))
            viewer.serve(lambda turns=turns: next(turns, None) is None)
        assert len(got) == 1
    finally:
        viewer.close()


def test_without_viser_a_run_ends_before_it_begins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    (tmp_path / "scene.yaml").write_text("source: {path: images}\ntracker: {kind: colmap}\noutput: out\n")
    result = CliRunner().invoke(app, ["run", str(tmp_path / "scene.yaml"), "--view"])
    assert (result.exit_code, result.stderr.count("\n"), result.stdout) == (2, 1, "")
    assert 'pip install "modp-ti[viewer]"' in result.stderr
    assert not (tmp_path / "out").exists()
