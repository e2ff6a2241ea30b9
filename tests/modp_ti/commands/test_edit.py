"""`modp-ti clean`, `crop` and `scale` on the output folder of a small run of the room, with splats planted in it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from fields.geometry.se3 import camera_centres
from modp_ti.commands.app import app
from modp_ti.engine.edited_run import Region
from modp_ti.outputs.formats.splats_ply import write_splats
from modp_ti.outputs.playback.finished_run import open_run
from modp_ti.outputs.playback.map_renderer import MapRenderer, start_device
from modp_ti.outputs.splat_page.page import levelled
from pipelines.whole.cleaning import harmless
from tests.modp_ti.runs import SHORT_RUN, finished_run
from tests.room import Room, RoomRecording

pytestmark = pytest.mark.slow
PLANTED = 6


def command(*arguments: object) -> dict:
    result = CliRunner().invoke(app, [*map(str, arguments), "--quiet", "--json"])
    data = json.loads(result.stdout)
    return data | {"code": result.exit_code}


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def planted(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run with splats of the map, in colours of chance, halfway between the cameras and the room's surfaces."""
    out = shutil.copytree(finished, tmp_path_factory.mktemp("planted") / "out")
    run, rng, room, places = open_run(out), np.random.default_rng(5), Room(), []
    for k in run.mapped:
        camera, T = run.cameras[k], run.poses[k]
        pixels = rng.uniform([0.25 * camera.width, 0.25 * camera.height], [0.75 * camera.width, 0.75 * camera.height])
        z = 0.5 * room.depth(camera, T, pixels[None])
        places.append((camera.unproject(pixels[None], z) - T[:3, 3]) @ T[:3, :3])
    state = run.gaussians
    pick = rng.choice(np.flatnonzero(state["opacity_logit"] > 0), PLANTED)
    new = {name: values[pick] for name, values in state.items()}
    centre = np.resize(np.concatenate(places), (PLANTED, 3))
    new["position"] = (centre + rng.normal(0, 0.05, centre.shape)).astype(np.float32)
    # As small as in pictures of a usual size: of 80x60, a splat of the map is a tenth when it is half as far.
    new["log_scale"] = new["log_scale"] - np.float32(1.2)
    new["sh"] = rng.normal(0, 1.2, new["sh"].shape).astype(np.float32)
    new["sh"][:, 1:] = 0
    write_splats(out / "splats.ply", {name: np.concatenate([state[name], new[name]]) for name in state})
    return out


def kept(before: Path, after: Path) -> NDArray[np.bool_]:
    """Which Gaussians of a map are those of another one, in every bit of all values."""

    def rows(folder: Path) -> list[bytes]:
        state = open_run(folder).gaussians
        return [
            b"".join(values) for values in zip(*([row.tobytes() for row in v] for v in state.values()), strict=True)
        ]

    there = set(rows(after))
    return np.array([row in there for row in rows(before)])


def test_planted_splats_are_removed_and_those_of_surfaces_stay(planted: Path, tmp_path: Path) -> None:
    before = files(planted)
    found = command("clean", planted, "-o", tmp_path / "clean")
    assert found["code"] == 0
    stays = kept(planted, tmp_path / "clean")
    assert (~stays[-PLANTED:]).mean() >= 0.9
    room = Room()
    xyz = open_run(planted).gaussians["position"][:-PLANTED]
    on_surface = room.distance(xyz) < 0.05
    assert (~stays[:-PLANTED])[on_surface].mean() <= 0.005
    assert found["after"] > found["before"]
    assert found["kept"] + sum(found["removed"].values()) == len(stays) and found["kept"] == stays.sum()
    assert files(planted) == before


def test_a_run_that_cleans_its_map_ends_with_what_clean_leaves(
    finished: Path, room_recording: RoomRecording, tmp_path: Path
) -> None:
    command("clean", finished, "-o", tmp_path / "clean")
    room_recording.write(tmp_path / "run")
    scene = SHORT_RUN.replace("mapping: {", "mapping: {clean: auto, ")
    out = finished_run(tmp_path / "run", scene, "PSNR of held-out frames")
    one, other = (open_run(folder).gaussians for folder in (tmp_path / "clean", out))
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["gaussians"] == metrics["clean"]["kept"] == len(one["position"])


def test_every_command_takes_the_new_folder(planted: Path, tmp_path: Path) -> None:
    part = tmp_path / "part"
    cut = command("crop", planted, "--around-cameras", 2.5, "-o", part)
    run = open_run(planted)
    poses, xyz = run.poses, run.gaussians["position"].astype(float)
    near = np.min([np.linalg.norm(xyz - c, axis=1) for c in camera_centres(poses)], axis=0) <= 2.5
    np.testing.assert_array_equal(kept(planted, part), near)
    assert (cut["kept"], cut["removed"]) == (near.sum(), (~near).sum())
    np.testing.assert_array_equal(open_run(part).poses, poses)
    assert command("export", part, "--format", "points", "-o", tmp_path / "points.ply")["code"] == 0
    assert command("render", part, "--frames", 2, "--path", "orbit", "-o", tmp_path / "orbit")["code"] == 0
    assert command("refine", part, "--steps", 1)["metrics"]["gaussians"] <= cut["kept"]


@pytest.mark.parametrize(
    "wrong", [(), ("--box", "1,2,3"), ("--sphere", "0,0,0,x"), ("--sphere", "99,99,99,0.1"), ("--above", "9999")]
)
def test_a_region_without_meaning_or_content_writes_nothing(planted: Path, tmp_path: Path, wrong: tuple) -> None:
    found = command("crop", planted, *wrong, "-o", tmp_path / "none")
    assert found["code"] == 2 and found["error"]
    assert not (tmp_path / "none").exists()


def test_the_map_of_a_run_is_never_replaced_but_that_of_an_earlier_crop_is(planted: Path, tmp_path: Path) -> None:
    other = shutil.copytree(planted, tmp_path / "other")
    before = files(planted)
    for output in (planted, other):
        assert command("crop", planted, "--above", -9, "-o", output)["code"] == 2
        assert files(output) == before
    for reach in (9, 2.5):
        found = command("crop", planted, "--around-cameras", reach, "-o", tmp_path / "part")
        assert len(open_run(tmp_path / "part").gaussians["position"]) == found["kept"]


def test_regions_are_met_together_and_move_with_the_world() -> None:
    rng = np.random.default_rng(2)
    xyz = rng.uniform(-3, 3, (500, 3))
    centres = rng.uniform(-1, 1, (5, 3))
    region = Region([2, 2, 2, -2, -2, -2], [0, 0, 0, 2.5], 2.5, -1.0)
    expected = (
        (np.abs(xyz) <= 2).all(axis=1)
        & (np.linalg.norm(xyz, axis=1) <= 2.5)
        & (np.linalg.norm(xyz[:, None] - centres, axis=2).min(axis=1) <= 2.5)
        & (-(xyz[:, 1] - np.median(centres[:, 1])) >= -1.0)
    )
    assert 20 < expected.sum() < 400
    np.testing.assert_array_equal(region.contains(xyz, centres, np.array([0.0, 1.0, 0.0])), expected)


def test_less_is_taken_where_all_would_cost_too_much() -> None:
    """A quality that falls by 0.01 dB for each Gaussian of one kind, and rises for those of the other."""
    faulty, dear = np.arange(40) < 8, (np.arange(40) >= 8) & (np.arange(40) < 24)

    def score(there: NDArray[np.bool_]) -> float:
        return 30.0 + 0.01 * (~there & faulty).sum() - 0.01 * (~there & dear).sum()

    shows = np.arange(40)[::-1].astype(float)
    taken, before, after = harmless({"good": faulty, "bad": dear}, shows, score, 0.05)
    np.testing.assert_array_equal(taken["good"], faulty)
    np.testing.assert_array_equal(np.flatnonzero(taken["bad"]), np.arange(16, 24))  # the half that shows least
    assert (before, after) == (30.0, pytest.approx(30.0))
    assert not harmless({"bad": dear}, shows, lambda there: 0.0 if there.all() else -9.0, 0.05)[0]["bad"].any()


def test_a_map_in_metres_and_upright_shows_the_same_pictures(finished: Path, tmp_path: Path) -> None:
    before = files(finished)
    points = ["20,20@4", "60,40@4"]
    first = command("measure", finished, *points)["length"]["value"]
    done = command(
        "scale", finished, "--from", points[0], "--to", points[1], "--metres", 2.1, "--upright", "-o", tmp_path / "m"
    )
    assert done["code"] == 0 and done["factor"] == pytest.approx(2.1 / first)
    again = command("measure", tmp_path / "m", *points)
    assert again["unit"] == "m" and again["length"]["value"] == pytest.approx(2.1, rel=1e-4)
    old, new = open_run(finished), open_run(tmp_path / "m")
    a, b = camera_centres(old.poses), camera_centres(new.poses)
    R, _ = Rotation.align_vectors(b - b.mean(axis=0), done["factor"] * (a - a.mean(axis=0)))
    np.testing.assert_allclose(done["factor"] * a @ R.as_matrix().T, b, atol=1e-5)
    assert R.apply([0.0, 0.0, 1.0]) @ [0.0, -1.0, 0.0] > np.cos(np.radians(15.0))  # z is up in the room
    np.testing.assert_allclose(levelled(new).R, np.eye(3), atol=1e-12)
    assert levelled(new).scale == 1.0 != levelled(old).scale  # in the page too
    for name in ("near", "scene_depth"):
        assert getattr(new.record, name) == pytest.approx(done["factor"] * getattr(old.record, name))
    pictures = []
    for run in (old, new):
        start_device("cpu")
        renderer = MapRenderer(run.gaussians, *run.size, run.record.near)
        pictures.append(renderer.picture(run.cameras[4], run.poses[4]).astype(int))
    assert np.abs(pictures[0] - pictures[1]).max() <= 2
    models = [pycolmap.Reconstruction(str(run.folder / "colmap")) for run in (old, new)]
    errors = [np.mean([point.error for point in model.points3D.values()]) for model in models]
    for model in models:
        model.update_point_3d_errors()
    assert errors[1] == pytest.approx(errors[0])
    np.testing.assert_allclose(
        [models[1].points3D[i].xyz for i in models[1].points3D],
        [done["factor"] * R.apply(models[0].points3D[i].xyz) for i in models[1].points3D],
        atol=1e-5,
    )
    assert command("crop", tmp_path / "m", "--around-cameras", 9, "-o", tmp_path / "part")["code"] == 0
    assert command("measure", tmp_path / "part", *points)["unit"] == "m"
    assert files(finished) == before


@pytest.mark.parametrize(
    "wrong",
    [(), ("--metres", 2), ("--from", "1,1@0", "--metres", 2), ("--marker", "tag36h11"), ("--upright", "--metres", 1)],
)
def test_a_scale_that_is_not_whole_is_refused(finished: Path, tmp_path: Path, wrong: tuple) -> None:
    found = command("scale", finished, *wrong, "-o", tmp_path / "none")
    assert found["code"] == 2 and found["error"]
    assert not (tmp_path / "none").exists()


def test_what_is_exported_for_the_earth_needs_a_place_on_it(finished: Path, tmp_path: Path) -> None:
    run = shutil.copytree(finished, tmp_path / "run")
    wanted = "export", run, "--format", "splat-glb", "--georeference"
    assert command(*wanted)["code"] == 2
    origin = {"latitude": 47.0, "longitude": 8.0, "height": 400.0}
    (run / "world.json").write_text(json.dumps({"unit": "m", "down": [0, 1, 0], "origin": origin}))
    assert command(*wanted)["code"] == 0
    tileset = json.loads((run / "splats.tileset.json").read_text())
    assert tileset["extras"]["origin"] == origin and (run / tileset["root"]["content"]["uri"]).is_file()
    assert command("scale", run, "--upright", "-o", tmp_path / "turned")["code"] == 0
    assert "origin" not in json.loads((tmp_path / "turned" / "world.json").read_text())
