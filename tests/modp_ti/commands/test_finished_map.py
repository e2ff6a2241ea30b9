"""`modp-ti render` and `modp-ti export` on the output folder of a real, small run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from plyfile import PlyData
from typer.testing import CliRunner, Result

from fields.geometry.se3 import camera_centres
from modp_ti.commands.app import app
from modp_ti.inputs.readers.transforms import TransformsSettings
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.outputs.formats.run_files import write_exposures
from modp_ti.outputs.formats.splats_ply import read_splats
from modp_ti.outputs.formats.trajectory import read_trajectory, write_trajectory
from modp_ti.outputs.playback.film import plan_flight
from modp_ti.outputs.playback.finished_run import open_run
from modp_ti.outputs.playback.map_renderer import MapRenderer, start_device
from tests.modp_ti.outputs.formats.splat_readers import READERS
from tests.opening import opened_with
from tests.room import HIGH, LOW

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def out(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the finished run's folder: exports are written into it."""
    folder = tmp_path_factory.mktemp("finished")
    return shutil.copytree(finished, folder / "out")


def invoke(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, list(map(str, arguments)))


def done(*arguments: str | Path) -> Path:
    """The place that a command says it has written to."""
    result = invoke(*arguments)
    assert result.exit_code == 0, result.output
    return Path(result.stdout.removeprefix("written to ").strip())


def held_out_pairs(out: Path) -> dict[int, tuple[NDArray, NDArray]]:
    """Frame and render of the run's own pictures, by position."""
    return {
        int(path.stem): tuple(np.hsplit(cv2.imread(str(path))[..., ::-1], 2))
        for path in sorted((out / "renders").iterdir())
    }


def test_frames_json_says_which_frames_are_what(out: Path) -> None:
    data, metrics = (json.loads((out / name).read_text()) for name in ("frames.json", "metrics.json"))
    assert data["held_out"] == [0, 4, 8]
    assert len(data["keyframes"]) == metrics["keyframes"] and not set(data["keyframes"]) & {0, 4, 8}
    assert data["near"] == pytest.approx(0.01 * data["scene_depth"])
    assert 1.0 < data["scene_depth"] < 4.0  # metres, in the test room
    run = open_run(out)
    assert run.mapped == run.spread(6) == run.spread(100) == [1, 2, 3, 5, 6, 7]
    assert run.spread(3) == [1, 3, 6]


def test_the_recorded_path_shows_what_the_run_itself_showed(out: Path, tmp_path: Path) -> None:
    folder = done("render", out, "-o", tmp_path / "pictures")
    assert sorted(p.name for p in folder.iterdir()) == [f"{i:06d}.png" for i in range(9)]
    for index, (_, render) in held_out_pairs(out).items():
        picture = cv2.imread(str(folder / f"{index:06d}.png"))[..., ::-1]
        np.testing.assert_array_equal(picture, render)


def test_exposure_is_that_of_each_frame_where_it_is_asked_for(out: Path, tmp_path: Path) -> None:
    run = shutil.copytree(out, tmp_path / "run")
    assert "--exposure" in failure("render", run, "--exposure", "-o", tmp_path / "none")
    matrix = np.array([[0.5, 0.1, 0, 0.05], [0, 0.6, 0, 0.1], [0, 0, 0.7, 0.0]])
    exposures = [matrix if index == 4 else np.eye(3, 4) for index in range(9)]
    write_exposures(run / "exposure.json", range(9), [0.1 * index for index in range(9)], exposures, {1, 5})
    assert "--exposure" in failure("render", run, "--exposure", "--path", "orbit")
    neutral, exposed = (
        done("render", run, "-o", tmp_path / name, *option) for name, option in (("n", ()), ("e", ("--exposure",)))
    )
    for index in (3, 4):
        before, after = (cv2.imread(str(f / f"{index:06d}.png"))[..., ::-1].astype(float) for f in (neutral, exposed))
        expected = before @ exposures[index][:, :3].T + 255 * exposures[index][:, 3]
        unclipped = (before > 0).all(axis=2) & (before < 255).all(axis=2)
        assert unclipped.mean() > 0.5
        assert np.abs(after - expected)[unclipped].max() <= 1.1


def test_depth_is_that_of_the_room(out: Path, tmp_path: Path) -> None:
    folder = done("render", out, "-o", tmp_path / "depth", "--show", "depth")
    z = cv2.imread(str(folder / "000004.tiff"), cv2.IMREAD_UNCHANGED)
    assert z.dtype == np.float32 and z.shape == (60, 80)
    assert (z > 0).mean() > 0.5
    assert 1.0 < np.median(z[z > 0]) < 4.0
    folder = done("render", out, "-o", tmp_path / "png", "--show", "depth", "--encoding", "png")
    unit = json.loads((folder / "unit.json").read_text())["scene_units"]
    steps = cv2.imread(str(folder / "000004.png"), cv2.IMREAD_UNCHANGED)
    assert unit == 0.001 and np.abs(unit * steps - z).max() <= 0.51 * unit


def test_a_panorama_is_level_and_holds_the_recorded_view(out: Path, tmp_path: Path) -> None:
    folder = done("render", out, "-o", tmp_path / "around", "--panorama", 256)
    pictures = [cv2.imread(str(folder / f"{i:06d}.png")) for i in range(9)]
    assert all(picture.shape == (128, 256, 3) for picture in pictures)
    seen = pictures[4].astype(float).max(axis=2) > 30
    assert seen[:, 96:160].mean() > 2 * seen[:, :64].mean()  # ahead, and not behind
    film = done("render", out, "-o", tmp_path / "around.mp4", "--panorama", 256, "--show", "normals")
    assert cv2.VideoCapture(str(film)).get(cv2.CAP_PROP_FRAME_COUNT) == 9


def test_a_video_has_the_frames_and_the_size_that_were_asked_for(out: Path, tmp_path: Path) -> None:
    flight = plan_flight(open_run(out), "smoothed", frames=7, deviation=3.0)
    assert len(flight.poses) == len(flight.cameras) == 7
    place = done("render", out, "--path", "orbit", "--frames", 5, "--size", "65x48", "-o", tmp_path / "film.mp4")
    video = cv2.VideoCapture(str(place))
    assert (video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (64, 48)
    pictures = []
    while (frame := video.read())[0]:
        pictures.append(frame[1])
    assert len(pictures) == 5
    assert min(picture.std() for picture in pictures) > 10  # something is to be seen
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]
    video = cv2.VideoCapture(str(done("export", out, "--format", "video", "-o", tmp_path / "recorded.mp4")))
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), round(video.get(cv2.CAP_PROP_FPS))) == (9, 10)


def test_a_path_of_ones_own_and_a_wider_view(out: Path, tmp_path: Path) -> None:
    times, poses = read_trajectory(out / "trajectory.txt")
    write_trajectory(tmp_path / "mine.txt", times[4:5], poses[4:5])
    folder = done("render", out, "--path", tmp_path / "mine.txt", "-o", tmp_path / "same")
    _, render = held_out_pairs(out)[4]
    same = cv2.imread(str(folder / "000000.png"))[..., ::-1]
    np.testing.assert_array_equal(same, render)
    # The recorded camera sees 2 atan(2 / 3) degrees across: at twice the tangent, all is half as large.
    wide = 2 * np.degrees(np.arctan(2 * 2 / 3))
    folder = done("render", out, "--path", tmp_path / "mine.txt", "--fov", wide, "-o", tmp_path / "wide")
    wide = cv2.imread(str(folder / "000000.png"))[..., ::-1].astype(np.float64)
    half = cv2.resize(same, (40, 30), interpolation=cv2.INTER_AREA).astype(np.float64)
    assert np.abs(wide[15:45, 20:60] - half).mean() < 12


def mean_squared_error(renderer: MapRenderer, out: Path, state: dict) -> float:
    """Of the Gaussians that some reader found, over the held-out frames [squared levels of 255]."""
    run = open_run(out)
    full = np.zeros_like(run.gaussians["sh"])
    full[:, : state["sh"].shape[1]] = state["sh"]
    renderer.renderer.gaussians.load({**state, "sh": full})
    errors = []
    for index, (frame, _) in held_out_pairs(out).items():
        picture = renderer.picture(run.cameras[index], run.poses[index]).astype(np.float64)
        errors.append(((picture - frame) ** 2).mean())
    return float(np.exp(np.mean(np.log(errors))))  # as the mean of decibels


def test_every_form_of_the_splats_shows_the_same_map(out: Path, taichi_on_the_cpu: None) -> None:
    """Read by another implementation: the PLY to the rounding of pictures, what is compressed within 0.75 levels."""
    forms = ("splat", "spz", "sog", "compressed-ply")
    files = {form: done("export", out, "--format", form) for form in forms}
    assert {path.parent for path in files.values()} == {out}
    start_device("cpu")
    run = open_run(out)
    show = MapRenderer(run.gaussians, 80, 60, run.record.near)
    ours, ply = mean_squared_error(show, out, run.gaussians), READERS["ply"](out / "splats.ply")
    metrics = json.loads((out / "metrics.json").read_text())
    in_the_run = 255**2 * 10 ** (-metrics["refined"]["held_out"]["psnr"] / 10)
    # Frame and render were each rounded to whole levels, whose variance is a twelfth.
    assert -0.02 <= ours - in_the_run <= 2 / 12 + 0.02
    assert abs(mean_squared_error(show, out, ply) - ours) <= 0.02
    # `.splat` holds no colours beyond [0, 1] and none that depend on the direction: fitted, it is better than clipped.
    held = np.clip(0.5 + 0.2820948 * ply["sh"][:, :1], 0, 1)
    clipped = mean_squared_error(show, out, {**ply, "sh": (held - 0.5) / 0.2820948})
    for form, path in files.items():
        there = mean_squared_error(show, out, READERS[form](path))
        assert there < clipped if form == "splat" else abs(there - ours) <= 0.75, form


def test_the_report_links_to_the_page_of_the_map_once_it_is_there(out: Path, tmp_path: Path) -> None:
    run = shutil.copytree(out, tmp_path / "run")
    (run / "report.html").write_text('<p id="map" hidden><a href="map.html">the map in 3D</a></p>')
    done("export", run, "--format", "html", "-o", tmp_path / "elsewhere.html")
    assert "hidden" in (run / "report.html").read_text()
    assert done("export", run, "--format", "html") == run / "map.html"
    assert (run / "report.html").read_text() == '<p id="map"><a href="map.html">the map in 3D</a></p>'


def test_points_are_the_opaque_gaussians(out: Path, tmp_path: Path) -> None:
    import open3d as o3d

    cloud = o3d.io.read_point_cloud(str(done("export", out, "--format", "points", "-o", tmp_path / "p.ply")))
    state = read_splats(out / "splats.ply")
    solid = state["opacity_logit"] >= 0
    np.testing.assert_allclose(np.asarray(cloud.points), state["position"][solid], atol=1e-6)
    colours = np.clip(0.5 + 0.2820948 * state["sh"][solid, 0], 0, 1)
    np.testing.assert_allclose(np.asarray(cloud.colors), colours, atol=1.01 / 255)


def test_a_mesh_lies_in_the_room(out: Path, tmp_path: Path) -> None:
    import open3d as o3d

    mesh = o3d.io.read_triangle_mesh(str(done("export", out, "--format", "mesh", "-o", tmp_path / "m.ply")))
    vertices = np.asarray(mesh.vertices)
    assert len(mesh.triangles) > 1000
    inside = ((vertices > LOW - 0.2) & (vertices < HIGH + 0.2)).all(axis=1)
    assert inside.mean() > 0.8
    assert np.asarray(mesh.vertex_colors).std() > 0.05


def test_a_mesh_is_made_of_the_map_s_own_pictures_where_the_images_are_gone(out: Path, tmp_path: Path) -> None:
    import open3d as o3d

    run = shutil.copytree(out, tmp_path / "run")
    config = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(config.replace("/images", "/gone"))
    result = invoke("export", run, "--format", "mesh")
    assert result.exit_code == 0
    assert "note: matching the map's own pictures" in result.stderr
    assert len(o3d.io.read_triangle_mesh(str(run / "mesh.ply")).triangles) > 1000


@pytest.mark.parametrize("kept", [False, True])
def test_a_colmap_data_set_has_model_and_images(out: Path, tmp_path: Path, kept: bool) -> None:
    """Whether the run kept its images or they are read again from its source."""
    source = shutil.copytree(out, tmp_path / "run")
    if kept:
        first = done("export", source, "--format", "colmap", "-o", tmp_path / "first")
        shutil.copytree(first / "images", source / "colmap" / "images")
        shutil.copytree(first / "sparse" / "0", source / "colmap", dirs_exist_ok=True)
    folder = done("export", source, "--format", "colmap", "-o", tmp_path / "set")
    model, before = (pycolmap.Reconstruction(str(p)) for p in (folder / "sparse" / "0", out / "colmap"))
    for number, image in model.images.items():
        assert image.name.endswith(".png")
        picture = cv2.imread(str(folder / "images" / image.name))
        camera = model.cameras[image.camera_id]
        assert picture.shape == (camera.height, camera.width, 3)
        np.testing.assert_array_equal(image.cam_from_world().matrix(), before.images[number].cam_from_world().matrix())
    assert len(model.points3D) == len(before.points3D)
    for index, (frame, _) in held_out_pairs(out).items():
        np.testing.assert_array_equal(
            cv2.imread(str(folder / "images" / model.images[index + 1].name))[..., ::-1], frame
        )


def test_a_nerfstudio_data_set_is_read_by_our_own_reader_and_has_its_split(out: Path, tmp_path: Path) -> None:
    folder = done("export", out, "--format", "nerfstudio", "-o", tmp_path / "ns")
    data = json.loads((folder / "transforms.json").read_text())
    assert data["camera_model"] == "OPENCV" and (data["w"], data["h"]) == (80, 60)
    assert len(data["test_filenames"]) == 3 and len(data["train_filenames"]) == 6
    assert data["val_filenames"] == data["test_filenames"]  # nerfstudio refuses a set that lists two splits of three
    assert not set(data["train_filenames"]) & set(data["test_filenames"])
    assert PlyData.read(folder / data["ply_file_path"])["vertex"].count > 100
    source, tracker = SourceSettings(path=folder / "images"), TransformsSettings(path=folder)
    frames = list(opened_with(source, tracker))
    run = open_run(out)
    for frame, T, camera in zip(frames, run.poses, run.cameras, strict=True):
        np.testing.assert_allclose(frame.T_camera_world, T, atol=1e-9)
        assert frame.camera == camera


def test_collision_shapes_bound_what_the_cameras_saw(out: Path, tmp_path: Path) -> None:
    folder = done("export", out, "--format", "collision", "--voxel", 0.1, "-o", tmp_path / "shapes")
    assert sorted(p.name for p in folder.iterdir()) == ["map.pgm", "map.yaml", "mesh.glb", "voxels.bt", "voxels.npz"]
    with np.load(folder / "voxels.npz") as file:
        at = camera_centres(open_run(out).poses) @ file["T_grid_world"][:3, :3].T + file["T_grid_world"][:3, 3]
        index = np.floor((at - file["origin"]) / file["voxel"]).astype(int)
        assert file["voxel"] == 0.1 and (file["state"][tuple(index.T)] == 1).all()
        assert (file["state"] == 2).sum() > 50 < (file["state"] == 0).sum()
        np.testing.assert_allclose(file["T_grid_world"][2, :3], [0.0, 0.0, 1.0], atol=0.2)  # z is up in the test room


def failure(*arguments: str | Path) -> str:
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    return result.stderr


@pytest.mark.parametrize(
    ("call", "named"),
    [
        ("export --format mesh -o m.stl", "m.stl"),
        ("export --format mesh --texture -o m.ply", "m.ply"),
        ("export --format points --texture", "--texture"),
        ("export --format spz --voxel 0.1", "--voxel"),
        ("export --format html --spz-version 3", "--spz-version"),
        ("export --format mesh --height 1", "--height"),
        ("export --format spz -o {out}/splats.ply/here.spz", "splats.ply"),
        ("export --format points -o {out}/splats.ply", "splats.ply"),
        ("export --format video -o film.avi", ".mp4"),
        ("render --path gone.txt", "gone.txt"),
        ("render --size 640", "--size"),
        ("render --size 5000x100", "2048"),
        ("render --frames 5", "--frames"),
        ("render --smooth 5", "--smooth"),
        ("render --fps 5 -o pictures", "--fps"),
        ("render --panorama 512 --fov 90", "--panorama"),
        ("render --show normals --encoding png", "--encoding"),
        ("render -o {out}", "{out}"),
    ],
)
def test_what_cannot_be_made_is_refused_in_one_line(out: Path, call: str, named: str) -> None:
    command, *options = call.format(out=out).split()
    said = failure(command, out, *options)
    assert said.startswith("error: ") and said.count("\n") == 1 and named.format(out=out) in said


def test_what_is_no_finished_run_is_refused(out: Path, tmp_path: Path) -> None:
    assert str(tmp_path / "gone") in failure("render", tmp_path / "gone")
    assert str(tmp_path) in failure("render", tmp_path)
    broken = shutil.copytree(out, tmp_path / "broken")
    (broken / "frames.json").write_text('{"near": 0.1, "scene_depth": 1, "keyframes": [99], "held_out": []}')
    assert "frames.json" in failure("render", broken)
    for name, command in (("frames.json", ["render"]), ("trajectory.txt", ["export", "--format", "mesh"])):
        (broken / name).unlink()
        assert name in failure(command[0], broken, *command[1:])
        shutil.copy(out / name, broken)
