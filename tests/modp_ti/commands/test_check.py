"""`modp-ti check` names what is wrong with an input, and finds nothing wrong with one that is right."""

from __future__ import annotations

import json
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from typer.testing import CliRunner

from modp_ti.commands.app import app
from tests.modp_ti.inputs.tracker_server import clients as clients

pytestmark = pytest.mark.slow

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def checked(scene: Path, *arguments: str) -> tuple[int, dict]:
    """Exit code and JSON."""
    result = CliRunner().invoke(app, ["check", str(scene), "--json", *arguments])
    return result.exit_code, json.loads(result.stdout)


def codes(data: dict) -> dict[str, str]:
    return {finding["code"]: finding["severity"] for finding in data["findings"]}


def planted(model: Path, target: Path, pose: Callable = lambda T: T, intrinsics: float = 1.0) -> None:
    """Write the COLMAP model with other poses and intrinsics; sizes, points and observations stay."""
    source = pycolmap.Reconstruction(str(model))
    result = pycolmap.Reconstruction()
    for camera in source.cameras.values():
        camera.params = np.array(camera.params) * intrinsics
        result.add_camera_with_trivial_rig(camera)
    for number, image in source.images.items():
        T = np.eye(4)
        T[:3] = image.cam_from_world().matrix()
        points = pycolmap.Point2DList([pycolmap.Point2D(p.xy) for p in image.points2D])
        copy = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=number, points2D=points)
        result.add_image_with_trivial_frame(copy, pycolmap.Rigid3d(pose(T)[:3]))
    for point in source.points3D.values():
        result.add_point3D(point.xyz, point.track)
    target.mkdir(parents=True)
    result.write_binary(str(target))


def turning(seed: int, angle: float, shift: float = 0.0) -> Callable[[np.ndarray], np.ndarray]:
    """Poses that have nothing to do with those that were."""
    rng = np.random.default_rng(seed)

    def turned(T: np.ndarray) -> np.ndarray:
        by = np.eye(4)
        by[:3, :3] = cv2.Rodrigues(rng.normal(0, angle, 3))[0]
        by[:3, 3] = rng.normal(0, 1, 3) * shift
        return by @ T

    return turned


@pytest.fixture
def model(plane_scene) -> Path:
    """The COLMAP model of the photographs of a plane, with points on it."""
    return plane_scene.write_colmap(np.c_[np.random.default_rng(2).uniform(-1.8, 1.8, (300, 2)), np.zeros(300)])


FAULTS = {
    "as_stated": ({}, None),
    "inverse_poses": ({"pose": np.linalg.inv}, "the poses are inverted"),
    "opengl_axes": ({"pose": lambda T: OPENGL @ T}, "the poses have OpenGL axes"),
    "inverse_poses_with_opengl_axes": ({"pose": lambda T: np.linalg.inv(OPENGL @ T)}, "the poses are inverted, and"),
    "intrinsics_of_half_the_size": ({"intrinsics": 0.5}, "the intrinsics belong to images of half the size"),
    "intrinsics_of_twice_the_size": ({"intrinsics": 2.0}, "the intrinsics belong to images of twice the size"),
}


def scene_file(folder: Path, images: Path, model: Path, **source: object) -> Path:
    file = folder / "scene.yaml"
    keys = "".join(f", {key}: {value}" for key, value in source.items())
    file.write_text(f"source: {{path: {images}{keys}}}\ntracker: {{kind: colmap, path: {model}}}\noutput: out\n")
    return file


def assert_named(fault: str, code: int, data: dict) -> None:
    _, text = FAULTS[fault]
    if text is None:
        assert "unusable" not in codes(data).values()
        assert data["conventions"][0]["features_fit"] > 0.95
        return
    assert code == 2
    assert data["verdict"] == "unusable"
    (found,) = [f for f in data["findings"] if f["code"] == fault]
    assert found["severity"] == "unusable"
    assert text in found["text"]
    assert found["mend"]
    assert not set(codes(data)) & (set(FAULTS) - {fault})


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_is_named(fault: str, plane_scene, model: Path, tmp_path: Path) -> None:
    planted(model, tmp_path / "fault", **FAULTS[fault][0])
    assert_named(fault, *checked(scene_file(tmp_path, plane_scene.folder, tmp_path / "fault")))


@pytest.mark.parametrize("fault", ["as_stated", "inverse_poses", "opengl_axes", "intrinsics_of_half_the_size"])
def test_a_planted_fault_is_named_on_desk(fault: str, shared_data, tmp_path: Path) -> None:
    desk = shared_data("desk")
    planted(desk / "sparse" / "0", tmp_path / "fault", **FAULTS[fault][0])
    file = scene_file(tmp_path, desk / "images", tmp_path / "fault", scale=0.25, stop=9)
    assert_named(fault, *checked(file))


def test_poses_of_another_recording_are_refused_by_check_and_by_a_run_unless_it_is_forced(
    plane_scene, model: Path, tmp_path: Path
) -> None:
    planted(model, tmp_path / "elsewhere", turning(5, 0.3, 0.5))
    code, data = checked(scene_file(tmp_path, plane_scene.folder, tmp_path / "elsewhere"))
    assert (code, codes(data)["poses_do_not_fit"]) == (2, "unusable")
    planted(model, tmp_path / "fault", turning(5, 0.1))
    scene = scene_file(tmp_path, plane_scene.folder, tmp_path / "fault", scale=0.25)
    few = ["--set", "refine.steps=0", "--set", "mapping.optimise.steps=1", "--set", "device=cpu", "--json"]
    refused = CliRunner().invoke(app, ["run", str(scene), *few])
    assert refused.exit_code == 2 and not (tmp_path / "out" / "splats.ply").exists()
    assert CliRunner().invoke(app, ["run", str(scene), *few, "--force"]).exit_code == 0


@pytest.mark.parametrize("command", ["check", "run"])
def test_a_recording_of_held_out_frames_alone_is_unusable(
    command: str, plane_scene, model: Path, tmp_path: Path
) -> None:
    scene = scene_file(tmp_path, plane_scene.folder, model, stop=1, holdout=8)
    assert CliRunner().invoke(app, [command, str(scene), "--set", "device=cpu"]).exit_code == 2


def test_checking_a_reconstruction_leaves_nothing_behind(plane_scene, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(
        f"source: {{path: {plane_scene.folder}}}\ntracker: {{kind: sfm}}\noutput: {tmp_path / 'out'}\n"
    )
    checked(tmp_path / "scene.yaml")
    assert [path.name for path in tmp_path.iterdir() if path.name not in (plane_scene.folder.name, "sparse")] == [
        "scene.yaml"
    ]


def test_points_of_another_world_are_told_from_wrong_poses(plane_scene, model: Path, tmp_path: Path) -> None:
    damaged = pycolmap.Reconstruction(str(model))
    for point in damaged.points3D.values():
        point.xyz = 0.5 * point.xyz
    damaged.write_binary(str(model))
    code, data = checked(scene_file(tmp_path, plane_scene.folder, model))
    assert (code, codes(data)["points_do_not_fit"]) == (1, "warning")


def test_blurred_repeated_and_missing_frames_are_named(plane_scene, model: Path, tmp_path: Path) -> None:
    images, rng = {}, np.random.default_rng(3)
    for name in plane_scene.names:  # with the fine grain that photographs have
        smooth = cv2.imread(str(plane_scene.folder / name))
        images[name] = np.clip(smooth + rng.normal(0, 12, smooth.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(plane_scene.folder / name), images[name])
    cv2.imwrite(str(plane_scene.folder / "view10.png"), cv2.blur(images["view10.png"], (9, 1)))
    cv2.imwrite(str(plane_scene.folder / "view12.png"), images["view11.png"])
    for i in range(6):  # frames without a pose, sorted before view13: a gap of a fifth of a second at 30 a second
        cv2.imwrite(str(plane_scene.folder / f"view13-{i}.png"), images["view13.png"])
    code, data = checked(scene_file(tmp_path, plane_scene.folder, model))
    assert data["blurred"] == ["view10.png"]
    assert data["duplicates"] == ["view12.png"]
    assert data["time_gaps"] == ["view13.png"]
    assert data["notes"] == [f"6 of 13 images have no pose in {model}: skipped (the first: view13-0.png)"]
    assert codes(data)["duplicates"] == "warning"  # one in seven
    assert code >= 1


def test_the_figures_are_those_of_the_input(plane_scene, model: Path, tmp_path: Path) -> None:
    code, data = checked(scene_file(tmp_path, plane_scene.folder, model, scale=0.5, holdout=3))
    assert (code, data["verdict"]) == (0, "fine")
    assert (data["frames"], data["held_out"], data["size"], data["cameras"]) == (7, 3, [160, 120], 1)
    assert data["intrinsics"] == pytest.approx({"fx": 150, "fy": 149, "cx": 161.3 / 2, "cy": 118.6 / 2})
    assert data["lens"] == "images of 320x240, no distortion"
    assert data["seconds_between_frames"] == pytest.approx(1 / 30, rel=1e-4)
    assert data["observations"] == 0  # their pixels were computed
    seen = [sum(p.has_point3D() for p in i.points2D) for i in pycolmap.Reconstruction(str(model)).images.values()]
    assert data["points"] == {"median": int(np.median(seen)), "least": min(seen), "most": max(seen)}
    centres = np.array([-T[:3, :3].T @ T[:3, 3] for T in plane_scene.T_camera_world])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert 3.5 < data["scale"]["depth"] < 5
    assert data["scale"]["longest_step"] == pytest.approx(steps.max() / data["scale"]["depth"], rel=1e-4)


def test_frames_that_come_through_a_socket_are_checked_as_they_arrive(plane_scene, tmp_path: Path) -> None:
    K = plane_scene.K

    def send() -> None:
        path = tmp_path / "server"
        while not path.exists():
            time.sleep(0.05)
        with clients.connect(path) as connection:
            start = struct.pack("<IIII12d", 320, 240, 2, 0, K[0, 0], K[1, 1], K[0, 2], K[1, 2], *[0.0] * 8)
            connection.sendall(clients.message(clients.HELLO, start))
            for i, (name, T) in enumerate(zip(plane_scene.names, plane_scene.T_camera_world, strict=True)):
                data = (plane_scene.folder / name).read_bytes()
                connection.sendall(clients.message(clients.FRAME, clients.frame(i, T=np.linalg.inv(T), image=data)))
            connection.sendall(clients.message(clients.END))
            assert clients.answer(connection)[0] == clients.WELCOME
            assert clients.answer(connection)[0] == clients.DONE

    file = tmp_path / "scene.yaml"
    file.write_text("tracker: {kind: socket, path: server}\noutput: out\n")
    sender = threading.Thread(target=send)
    sender.start()
    code, data = checked(file)
    sender.join()
    assert (code, data["frames"]) == (2, 7)
    assert codes(data) == {"inverse_poses": "unusable", "points": "unusable"}


def test_a_person_reads_a_table_a_mend_and_a_verdict(plane_scene, model: Path, tmp_path: Path) -> None:
    planted(model, tmp_path / "fault", np.linalg.inv)
    result = CliRunner().invoke(app, ["check", str(scene_file(tmp_path, plane_scene.folder, tmp_path / "fault"))])
    lines = result.stdout.splitlines()
    assert (result.exit_code, lines[-1]) == (2, "verdict: unusable")
    assert any(line.startswith("unusable: ") for line in lines) and any(line.startswith("    -> ") for line in lines)
    assert not (tmp_path / "out").exists()
    for scene in (scene_file(tmp_path, tmp_path / "fault", tmp_path / "none"), tmp_path / "none.yaml"):
        code, data = checked(scene)
        assert (code, data["verdict"], codes(data)) == (2, "unusable", {"input": "unusable"})
