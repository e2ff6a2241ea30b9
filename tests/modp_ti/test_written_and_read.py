"""What our writers write, whatever it is, our readers give back."""

from __future__ import annotations

import csv
import gzip
import io
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from fields.geometry.se3 import exp_se3
from modp_ti.files import parse_json
from modp_ti.files.trajectory import read_number_rows
from modp_ti.inputs.point_cloud import read_ply_points
from modp_ti.inputs.readers.aria import read_csv_blocks
from modp_ti.inputs.tracker_server.messages import Kind, State, encoded, parse_correction, parse_frame
from modp_ti.outputs.evaluation import FrameScore
from modp_ti.outputs.formats.run_files import read_frames, read_scores, write_frames, write_scores
from modp_ti.outputs.formats.splats_ply import read_splats, write_splats
from modp_ti.outputs.formats.trajectory import read_trajectory, write_trajectory

quick = settings(
    derandomize=True,
    max_examples=25,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)

# Taichi has the processor take the least numbers for zero.
float32 = st.floats(-(2.0**120), 2.0**120, width=32, allow_subnormal=False)
numbers = st.floats(-1e11, 1e11, allow_subnormal=False)
counts = st.integers(0, 12)
poses = st.tuples(*[st.floats(-50, 50)] * 3, *[st.floats(-1.5, 1.5)] * 3).map(exp_se3)
names = st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs", "Zl", "Zp"]), min_size=1, max_size=12)


@quick
@given(count=counts, degree=st.integers(0, 3), data=st.data())
def test_splats(tmp_path: Path, count: int, degree: int, data) -> None:
    shapes = {
        "position": (3,),
        "log_scale": (3,),
        "quaternion": (4,),
        "opacity_logit": (),
        "sh": ((degree + 1) ** 2, 3),
    }
    state = {
        name: data.draw(arrays.arrays(np.float32, (count, *shape), elements=float32, fill=float32))
        for name, shape in shapes.items()
    }
    write_splats(tmp_path / "splats.ply", state)
    again = read_splats(tmp_path / "splats.ply")
    assert set(again) == set(state)
    for name, values in state.items():
        assert again[name].tobytes() == values.tobytes(), name
    if count:
        xyz = state["position"].astype(np.float64)
        near = xyz[(np.abs(xyz) <= 1e12).all(axis=1)]
        np.testing.assert_array_equal(read_ply_points(tmp_path / "splats.ply"), near)


@quick
@given(times=st.lists(st.floats(0, 1e10, allow_subnormal=False), max_size=8), data=st.data())
def test_trajectories(tmp_path: Path, times: list[float], data) -> None:
    motions = [data.draw(poses) for _ in times]
    write_trajectory(tmp_path / "t.txt", times, motions)
    again, T = read_trajectory(tmp_path / "t.txt")
    assert again.tolist() == times
    np.testing.assert_allclose(T, np.array(motions).reshape(-1, 4, 4), atol=1e-12 * 100)


@quick
@given(near=st.floats(1e-9, 1e9), depth=st.floats(1e-9, 1e9), chosen=st.sets(st.integers(0, 50), min_size=1))
def test_frames(tmp_path: Path, near: float, depth: float, chosen: set[int]) -> None:
    write_frames(tmp_path / "frames.json", near, depth, chosen, set(range(51)) - chosen)
    record = read_frames(tmp_path / "frames.json", 51)
    assert (record.near, record.scene_depth) == (near, depth)
    assert (record.keyframes, record.held_out) == (sorted(chosen), sorted(set(range(51)) - chosen))


scores = st.builds(
    FrameScore,
    index=st.integers(0, 10**6),
    name=names,
    held_out=st.booleans(),
    stage=st.sampled_from(["online", "refined"]),
    psnr=st.floats(0, 100, allow_subnormal=False),
    ssim=st.floats(-1, 1, allow_subnormal=False),
    lpips=st.none() | st.floats(0, 2, allow_subnormal=False),
    detail=st.none() | st.floats(-2, 1, allow_subnormal=False),
)


@quick
@given(written=st.lists(scores, max_size=6))
def test_scores(tmp_path: Path, written: list[FrameScore]) -> None:
    write_scores(tmp_path / "scores.csv", written)
    assert read_scores(tmp_path / "scores.csv") == written


@quick
@given(
    rows=st.lists(st.tuples(*[numbers] * 4), min_size=1, max_size=8), separator=st.sampled_from([" ", ",", "\t", " , "])
)
def test_tables_of_numbers(tmp_path: Path, rows: list[tuple[float, ...]], separator: str) -> None:
    text = "# a table\n\n" + "".join(separator.join(map(repr, row)) + " # a row\n" for row in rows)
    (tmp_path / "rows.txt").write_text(text)
    found = read_number_rows(tmp_path / "rows.txt", 4, "a b c d")
    assert found.values.tolist() == [list(row) for row in rows]
    assert found.lines.tolist() == list(range(3, 3 + len(rows)))


@quick
@given(rows=st.lists(st.tuples(st.integers(-(2**62), 2**62), numbers), max_size=9), packed=st.booleans())
def test_columns(tmp_path: Path, rows: list[tuple[int, float]], packed: bool) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["other", "value", "id"])
    writer.writerows(["x", value, number] for number, value in rows)
    path = tmp_path / ("rows.csv.gz" if packed else "rows.csv")
    path.write_bytes(gzip.compress(text.getvalue().encode()) if packed else text.getvalue().encode())
    found = [tuple(row) for block in read_csv_blocks(path, {"id": "i8", "value": "f8"}) for row in block.tolist()]
    assert found == rows


ids = st.lists(st.integers(-(2**63), 2**63 - 1), max_size=5, unique=True)


@quick
@given(
    T=poses,
    time=st.floats(0, 1e12, allow_subnormal=False),
    seen=ids,
    image=st.binary(min_size=1, max_size=40),
    data=st.data(),
)
def test_messages_of_frames(T: np.ndarray, time: float, seen: list[int], image: bytes, data) -> None:
    places = [data.draw(st.tuples(*[numbers] * 5)) for _ in seen]
    block = b"".join(struct.pack("<q5d", i, *place) for i, place in zip(seen, places, strict=True))
    payload = struct.pack("<IId16dII", 7, 1, time, *T.ravel(), len(seen), len(image)) + block + image
    frame = parse_frame(payload, Kind.FRAME)
    assert (frame.number, frame.state, frame.timestamp, frame.image) == (7, State.KNOWN, time, image)
    np.testing.assert_allclose(frame.T_camera_world, T, atol=1e-12)
    assert frame.points.ids.tolist() == seen
    assert np.hstack([frame.points.xyz, frame.points.pixels]).tolist() == [list(place) for place in places]
    assert encoded(Kind.FRAME, payload)[:16] == struct.pack("<4sHHII", b"MODP", 1, 2, len(payload), 0)


@quick
@given(T=st.lists(poses, min_size=1, max_size=4), moved=ids, data=st.data())
def test_messages_of_corrections(T: list[np.ndarray], moved: list[int], data) -> None:
    places = [data.draw(st.tuples(*[numbers] * 3)) for _ in moved]
    payload = struct.pack("<II", len(T), len(moved))
    payload += b"".join(struct.pack("<II16d", 3 * i, 0, *pose.ravel()) for i, pose in enumerate(T))
    payload += b"".join(struct.pack("<q3d", i, *place) for i, place in zip(moved, places, strict=True))
    correction = parse_correction(payload)
    assert correction.numbers.tolist() == [3 * i for i in range(len(T))]
    np.testing.assert_allclose(correction.T_camera_world, T, atol=1e-12)
    assert correction.ids.tolist() == moved
    assert correction.xyz.tolist() == [list(place) for place in places]


data_of_json = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**17), 10**17)
    | st.floats(allow_nan=False, allow_subnormal=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=12,
)


@quick
@given(data=data_of_json, ascii_only=st.booleans())
def test_json(data: object, ascii_only: bool) -> None:
    import json

    try:
        text = json.dumps(data, ensure_ascii=ascii_only)
        text.encode()
    except UnicodeEncodeError:
        return
    if "\\ud" in text:
        return  # halves of a character are refused, which tests/modp_ti/test_reading.py says
    assert parse_json(text, "text") == data


@pytest.mark.parametrize("text", ["1e999", "-1e999", "9" * 5000])
def test_numbers_beyond_float64_become_infinite(text: str) -> None:
    assert math.isinf(parse_json(text, "text"))
