"""Points of PLY files are read in every form that writers use, and shown to the cameras that can see them."""

from __future__ import annotations

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.inputs.point_cloud import read_ply_points, read_point_file, visible_points
from modp_ti.inputs.sources import Undistorter

XYZ = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)


def binary(order: str) -> bytes:
    rows = np.zeros(20, dtype=[("x", order + "f4"), ("red", "u1"), ("y", order + "f4"), ("z", order + "f8")])
    rows["x"], rows["y"], rows["z"] = XYZ.T
    name = "little" if order == "<" else "big"
    header = (
        f"ply\nformat binary_{name}_endian 1.0\ncomment end of nothing\nelement vertex 20\nproperty float x\n"
        "property uchar red\nproperty float32 y\nproperty double z\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    return header.encode() + rows.tobytes() + b"\x03" + bytes(12)


def ascii_file() -> bytes:
    header = "ply\nformat ascii 1.0\nelement vertex 20\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    return (header + "\n".join(" ".join(repr(float(v)) for v in row) for row in XYZ) + "\n").encode()


@pytest.mark.parametrize("data", [binary("<"), binary(">"), ascii_file()], ids=["little", "big", "ascii"])
def test_points_are_read(tmp_path, data):
    (tmp_path / "p.ply").write_bytes(data)
    np.testing.assert_allclose(read_ply_points(tmp_path / "p.ply"), XYZ, rtol=1e-6)


@pytest.mark.parametrize("data", [binary("<")[:300], ascii_file()[:-200], b"", b"ply\n", b"jpeg"])
def test_damaged_file_is_named(tmp_path, data):
    (tmp_path / "p.ply").write_bytes(data)
    with pytest.raises(InputError, match=r"p\.ply: (the PLY file is damaged|not a PLY file)"):
        read_ply_points(tmp_path / "p.ply")


def test_file_without_positions_is_named(tmp_path):
    (tmp_path / "p.ply").write_bytes(ascii_file().replace(b"float z", b"float nz"))
    with pytest.raises(InputError, match="no x, y and z"):
        read_ply_points(tmp_path / "p.ply")
    with pytest.raises(InputError, match=r"gone\.ply"):
        read_ply_points(tmp_path / "gone.ply")


def test_points_that_are_not_finite_are_left_out(tmp_path):
    (tmp_path / "p.ply").write_bytes(ascii_file().replace(repr(float(XYZ[3, 1])).encode(), b"nan", 1))
    np.testing.assert_allclose(read_ply_points(tmp_path / "p.ply"), np.delete(XYZ, 3, axis=0), rtol=1e-6)


def pcd(form: str) -> bytes:
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x y z normal\nSIZE 4 4 4 4 4\nTYPE U F F F F\nCOUNT 1 1 1 1 3\n"
    head += f"WIDTH {len(XYZ)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(XYZ)}\nDATA {form}\n"
    if form == "ascii":
        return (head + "".join(f"255 {x!r} {y!r} {z!r} 0 0 1\n" for x, y, z in XYZ.tolist())).encode()
    table = np.zeros(len(XYZ), [("rgb", "<u4"), ("xyz", "<f4", 3), ("normal", "<f4", 3)])
    table["xyz"] = XYZ
    return head.encode() + table.tobytes()


@pytest.mark.parametrize("form", ["ply", "pcd ascii", "pcd binary", "npy", "text"])
def test_points_of_any_program_are_read_and_those_with_nan_left_out(tmp_path, form):
    file, xyz = tmp_path / "cloud", np.vstack([XYZ[:3], [[np.nan] * 3], XYZ[3:]])
    if form == "npy":
        with file.open("wb") as stream:
            np.save(stream, xyz)
    elif form == "text":
        np.savetxt(file, xyz)
    else:
        file.write_bytes(pcd(form.split()[1]) if form.startswith("pcd") else binary("<"))
    np.testing.assert_allclose(read_point_file(file), XYZ, rtol=1e-6)


@pytest.mark.parametrize(
    "data",
    [
        pcd("binary")[:-9],
        pcd("binary").replace(b"DATA binary", b"DATA binary_compressed"),
        b"# nothing\n",
        b"1 2 3\n1 2\n",
    ],
    ids=["cut", "compressed", "empty", "columns"],
)
def test_a_file_that_is_none_of_points_is_named(tmp_path, data):
    (tmp_path / "cloud").write_bytes(data)
    with pytest.raises(InputError, match="cloud"):
        read_point_file(tmp_path / "cloud")


def test_points_behind_another_surface_outside_or_behind_the_camera_are_not_seen():
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-1, 1, 80)))
    front = np.stack([x, y, np.full_like(x, 3.0)], axis=1)  # fills the view's middle
    hidden = np.stack([x, y, np.full_like(x, 6.0)], axis=1)  # projects inside the front's outline
    beside = np.array([[2.6, 0.0, 6.0]])
    others = np.array([[0.0, 0.0, -3.0], [50.0, 0.0, 3.0]])
    xyz = np.concatenate([front, hidden, beside, others])
    camera = Undistorter(PinholeCamera(300, 300, 160, 120, 320, 240), scale=0.5)
    seen = visible_points(xyz, camera, np.eye(4))
    assert set(seen.ids) == {*range(len(front)), len(front) + len(hidden)}
    np.testing.assert_allclose(seen.pixels, camera.camera.project(seen.xyz))
    assert np.array_equal(seen.xyz, xyz[seen.ids])
    assert len(visible_points(others, camera, np.eye(4))) == 0
