"""A map with room for a part of the long wall, whose other parts lie on disk."""

from __future__ import annotations

import gc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from fields.frames.pose_correction import PoseCorrection
from fields.map.keyframes import KeyframeStore
from fields.runtime import process
from fields.runtime.backend import initialise
from fields.voxels.occupancy import OccupancyVoxels
from modp_ti.outputs.formats.splats_ply import write_splats
from pipelines.companions import hidden_gaussians
from pipelines.companions.block_files import BlockError
from pipelines.companions.paging import Paging
from pipelines.densify import densifier
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from pipelines.state import restore_state, save_state
from tests.pipelines.wall import walked_along

pytestmark = pytest.mark.slow

POOL = 3072
# Out along the wall, and home.
STEPS = [*range(13), *range(12, -1, -1)]
OUT = 13


def mapper_of(folder: Path | None = None, **settings) -> OnlineMapper:
    initialise("cpu")
    chosen = {"sh_degree": 0, "optimise": {"steps": 1}, "densify": {"warm_up": 2}, "max_gaussians": POOL, **settings}
    return OnlineMapper(MappingSettings(**chosen), 64, 48, seed=1, folder=folder)


def walk(mapper: OnlineMapper, first: int = 0, end: int = len(STEPS)) -> OnlineMapper:
    for index in range(first, end):
        mapper.process(walked_along(index, STEPS[index]))
    return mapper


def mean_psnr(mapper: OnlineMapper) -> float:
    found = []
    for view in mapper.keyframes:
        mapper.paging.before_views([view])
        found.append(mapper.optimiser.compare(view, mapper.keyframes.scene_depth).psnr)
    return float(np.mean(found))


@pytest.fixture(scope="module")
def unlimited(taichi_on_the_cpu: None) -> tuple[int, float]:
    """Number of Gaussians, and mean PSNR of the keyframes, of the map without a limit."""
    mapper = walk(mapper_of(max_gaussians=100_000))
    mapper.finish()
    assert len(mapper.paging.away) == 0
    return len(mapper.gaussians), mean_psnr(mapper)


def test_a_map_beyond_its_pool_is_as_large_and_as_good(unlimited: tuple[int, float], tmp_path: Path) -> None:
    mapper = mapper_of(tmp_path / "blocks", max_gaussians=4096)
    for index, step in enumerate(STEPS):
        mapper.process(walked_along(index, step))
        assert len(mapper.gaussians) <= 4096
    mapper.finish()
    count, psnr = unlimited
    assert count > 1.2 * 4096  # or there is nothing to show
    assert mapper.caught().warning() is None and mapper.paging.problem is None
    assert mapper.gaussian_count == pytest.approx(count, rel=0.05)
    assert mean_psnr(mapper) > psnr - 2.0
    values = mapper.all_gaussians()
    assert {len(array) for array in values.values()} == {mapper.gaussian_count}
    assert list(tmp_path.iterdir()), "the blocks lie in the folder that was given"


def test_a_part_that_is_left_is_found_as_it_was_left(taichi_on_the_cpu: None) -> None:
    mapper = walk(mapper_of(), end=OUT)
    left = {block.number: mapper.paging.away.read(block) for block in mapper.paging.away}
    walk(mapper, OUT, OUT + 3)
    still = [block for block in mapper.paging.away if block.number in left]
    assert still
    for block in still:
        np.testing.assert_array_equal(mapper.paging.away.read(block), left[block.number])
    mapper.paging.before_views([mapper.keyframes[int(still[0].viewers[0])]])
    here, was = mapper.gaussians.to_numpy() | mapper.gaussians.history(), left[still[0].number]
    place = np.flatnonzero((here["position"] == was["position"][0]).all(axis=1))[0]
    for name, array in here.items():
        np.testing.assert_array_equal(array[place : place + len(was)], was[name])


def test_the_sky_is_never_put_away(taichi_on_the_cpu: None) -> None:
    mapper = walk(mapper_of(), end=3)
    depth = mapper.keyframes.scene_depth
    far = depth * np.array([[0.0, -30.0, 40.0], [30.0, -20.0, 35.0]])
    state = {name: array[:2] for name, array in mapper.gaussians.to_numpy().items()}
    state |= {"position": far, "log_scale": np.full((2, 3), np.log(1.1 * depth))}
    mapper.gaussians.append(**state, anchor=0)
    walk(mapper, 3, OUT)
    assert len(mapper.paging.away) > 0
    assert (np.linalg.norm(mapper.gaussians.to_numpy()["position"], axis=1) > 40 * depth).sum() == 2


def test_voxels_that_rest_change_nothing(taichi_on_the_cpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    mapper = walk(mapper_of())
    rests = mapper.densifier.voxels.marks()[2]
    assert rests.any() and not rests.all()
    held, values = mapper.densifier.voxels.nbytes, mapper.all_gaussians()
    monkeypatch.setattr(OccupancyVoxels, "rest", lambda *_: None)
    mapper = walk(mapper_of())
    assert held < mapper.densifier.voxels.nbytes
    for name, array in mapper.all_gaussians().items():
        np.testing.assert_array_equal(array, values[name])


def test_a_restored_map_goes_on_as_the_saved_one(taichi_on_the_cpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hidden_gaussians, "FIRST_SWEEP", 4)
    mapper = walk(mapper_of(), end=15)
    state = save_state(mapper)
    assert len(mapper.paging.away) > 0
    assert mapper.hidden.due <= 22  # so that the next sweep comes before the end
    arrays = {name: np.array(array) for name, array in state.arrays.items()}
    walk(mapper, 15, 22).finish()
    expected = mapper.all_gaussians()
    again = mapper_of()
    restore_state(again, type(state)(arrays, state.numbers), (walked_along(i, STEPS[i]) for i in range(15)))
    walk(again, 15, 22).finish()
    assert again.hidden.due == mapper.hidden.due
    assert again.densifier.voxels.nbytes == mapper.densifier.voxels.nbytes
    for name, array in again.all_gaussians().items():
        np.testing.assert_array_equal(array, expected[name])


def test_a_correction_moves_what_lies_on_disk(taichi_on_the_cpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(densifier, "MARKED_TOGETHER", 1000)
    mapper = walk(mapper_of(corrections={"steps": 0}), end=15)
    before, on_disk = mapper.all_gaussians(), int(mapper.paging.away.counts.sum())
    assert on_disk > 0
    shift = np.array([0.0, 2.0, 0.0])
    index = np.array(list(mapper.trajectory))
    T = np.stack([mapper.trajectory[int(i)] for i in index])
    T[:, :3, 3] -= T[:, :3, :3] @ shift
    report = mapper.correct(PoseCorrection(index, T, np.zeros(0, dtype=np.int64), np.zeros((0, 3))))
    after = mapper.all_gaussians()
    assert report.moved and mapper.gaussian_count == len(before["position"])
    expected = np.sort(before["position"] + shift, axis=0)  # a coordinate at a time, as blocks change their order
    np.testing.assert_allclose(np.sort(after["position"], axis=0), expected, atol=1e-4)
    position, _ = mapper.paging.placed()
    assert mapper.densifier.voxels.marks()[2].any()
    occupied = mapper.densifier.voxels.query(position, mapper.densifier.anchors[0].spacing)
    assert occupied.all()


def test_a_limit_of_memory_moves_keyframes_to_disk(taichi_on_the_cpu: None) -> None:
    free = walk(mapper_of(max_gaussians=100_000), end=OUT)
    limit = 0.75 * free.budget.held()
    count = len(free.gaussians)
    mapper = walk(mapper_of(max_gaussians=100_000, memory=limit / 1e9), end=OUT)
    assert mapper.budget.held() <= limit and mapper.caught().keyframes_without_room == 0
    assert mapper.gaussian_count == pytest.approx(count, rel=0.05)
    on_disk = [view for view in mapper.keyframes if view.pyramid[0].on_disk]
    assert on_disk
    for view in on_disk:
        given = walked_along(view.index, STEPS[view.index])
        np.testing.assert_array_equal(view.rgba, given.rgba)
        for name in ("xyz", "pixels", "ids"):
            np.testing.assert_array_equal(getattr(view.points, name), getattr(given.points, name))


def test_the_whole_map_is_what_lies_here_and_on_disk(
    taichi_on_the_cpu: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mapper = walk(mapper_of(tmp_path / "blocks"), end=OUT)
    away = mapper.paging.away
    parts = [mapper.gaussians.to_numpy(), *(away.read(block) for block in away)]
    assert len(parts) > 1
    files = {path.name for path in tmp_path.rglob("*.*")}
    mapped = mapper.all_gaussians()
    assert {path.name for path in tmp_path.rglob("*.*")} == files, "its file is gone when nobody needs the arrays"
    monkeypatch.setattr(process, "KEPT_FREE", 1 << 62)
    in_memory = mapper.all_gaussians()
    for name, array in mapped.items():
        assert not array.flags.owndata and in_memory[name].flags.owndata
        np.testing.assert_array_equal(array, np.concatenate([part[name] for part in parts]))
        np.testing.assert_array_equal(array, in_memory[name])


def test_a_damaged_block_is_named_and_the_map_goes_on_without_it(taichi_on_the_cpu: None) -> None:
    mapper = walk(mapper_of(), end=OUT)
    block = next(iter(mapper.paging.away))
    count, path = mapper.gaussian_count, block.stored.path
    content = bytearray(path.read_bytes())
    content[block.stored.first + 5] ^= 1
    path.write_bytes(content)
    with pytest.raises(BlockError, match=str(path)):
        mapper.paging.before_views([mapper.keyframes[int(block.viewers[0])]])
    assert mapper.gaussian_count == count - block.stored.count
    walk(mapper, OUT, OUT + 2)


def test_a_full_disk_is_told_and_leaves_out_what_has_no_room(
    taichi_on_the_cpu: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "KEPT_FREE", 1 << 60)
    mapper = walk(mapper_of(max_gaussians=2048), end=10)
    assert mapper.paging.problem == "blocks of the map cannot be kept on disk: No space left on device"
    assert len(mapper.paging.away) == 0 and len(mapper.gaussians) <= 2048
    assert mapper.caught().gaussians_without_room > 0


def test_hidden_gaussians_on_a_full_disk_stay_where_they_are(
    taichi_on_the_cpu: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    away = walk(mapper_of(), end=OUT).paging.away
    for block in away:
        block.sweep = away.sweep
    anchors = np.concatenate([away.read(block)["anchor"] for block in away])
    young, count = int(np.median(anchors)), len(anchors)
    spared = np.arange(anchors.max() + 1) >= young
    with monkeypatch.context() as full:
        full.setattr(process, "KEPT_FREE", 1 << 60)
        away.remove_hidden(1.0, spared)  # nothing has been measured: all but the young are hidden
    assert int(away.counts.sum()) == count
    away.remove_hidden(1.0, spared)
    left = np.concatenate([away.read(block)["anchor"] for block in away])
    np.testing.assert_array_equal(np.sort(left), np.sort(anchors[anchors >= young]))
    assert 0 < len(left) == int(away.counts.sum()) < count


def test_the_saved_map_holds_the_blocks_on_disk_whose_files_go_with_it(taichi_on_the_cpu: None, tmp_path: Path) -> None:
    (tmp_path / "blocks-of-mine").mkdir()
    mapper = walk(mapper_of(tmp_path / "blocks"), end=OUT)
    (folder,) = (tmp_path / "blocks").iterdir()
    assert (tmp_path / "blocks-of-mine").is_dir() and list(folder.glob("*.npy"))
    # The saved map is what is in memory and what lies in these files, one after the other.
    write_splats(tmp_path / "map.ply", mapper.all_gaussians())
    saved = PlyData.read(tmp_path / "map.ply")["vertex"]
    here, blocks = mapper.gaussians.to_numpy(), [mapper.paging.away.read(block) for block in mapper.paging.away]
    assert sum(map(len, blocks)) > 100
    for axis, name in enumerate("xyz"):
        parts = [here["position"][:, axis], *(block["position"][:, axis] for block in blocks)]
        np.testing.assert_array_equal(saved[name], np.concatenate(parts))
    opacity = [here["opacity_logit"], *(block["opacity_logit"] for block in blocks)]
    np.testing.assert_array_equal(saved["opacity"], np.concatenate(opacity))
    (tmp_path / "map.ply").unlink()
    del mapper
    gc.collect()
    assert not list((tmp_path / "blocks").iterdir()) and (tmp_path / "blocks-of-mine").is_dir()


def test_views_are_of_the_present_place_only_once_there_are_others_or_parts_of_the_map_lie_on_disk() -> None:
    """The scene is 4 m deep, the camera moves on by 5 m a keyframe, and another place is farther than 12 m."""
    store = KeyframeStore()
    for index in range(6):
        T = np.eye(4)
        T[0, 3] = -5.0 * index
        store.append(replace(walked_along(index, 0.0), T_camera_world=T))
    paging = Paging(None, store, None, MappingSettings())
    paging.most_missing = 10
    assert paging.near().tolist() == [0, 1, 2, 3, 4, 5]
    store.begins.add(4)
    assert paging.near().tolist() == [3, 4, 5]
    store.begins.clear()
    paging.away.missing[4] = 1
    assert paging.near().tolist() == [3, 4, 5]
    paging.away.missing[4] = 11
    assert paging.near().tolist() == [3, 5]
