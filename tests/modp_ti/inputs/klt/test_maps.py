"""Maps that are begun anew after the track was lost, and joined with each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fields.geometry.se3 import exp_se3, moved_points, moved_pose
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.klt.landmark_map import Keyframe, LandmarkMap
from modp_ti.inputs.klt.map_connection import MapJoining
from modp_ti.inputs.klt.recognition import Recognition
from modp_ti.inputs.multiview.reprojection import ray_errors
from tests.modp_ti.inputs.klt.conftest import BLACK, BoxRoom, followed, turning_walk


def mirrored(room: BoxRoom) -> BoxRoom:
    """Another place."""
    return replace(room, textures={wall: sheet[::-1].copy() for wall, sheet in room.textures.items()})


@pytest.mark.slow
@pytest.mark.parametrize("turned_first", [False, True])
def test_a_map_begun_after_a_cut_is_joined_when_it_shows_the_first_ones_place(box_room, box_walk, turned_first):
    there, walls = turning_walk(60), box_walk.poses[:30]
    there_greys, wall_greys = [box_room.grey(T) for T in there], box_walk.grey[:30]
    if turned_first:  # the second recording begins where the first one ended, and ends where it never was
        there, there_greys = there[:30], there_greys[:30]
        poses = [*there, *[None] * 8, *walls, *turning_walk(60)[:29:-1]]
        greys = [*there_greys, *[BLACK] * 8, *wall_greys, *[box_room.grey(T) for T in turning_walk(60)[:29:-1]]]
    else:
        poses, greys = [*walls, *[None] * 8, *there], [*wall_greys, *[BLACK] * 8, *there_greys]
    found = followed(box_room, greys, begins_anew_after=5)
    odometry, views = found.odometry, found.views
    truth = {i: T for i, T in enumerate(poses) if T is not None}
    assert odometry.joined == 1 and not odometry.waiting
    assert sorted(views) == sorted(truth)
    assert found.errors(truth).max() < 0.03
    late = max(len(each) for each in found.brought[10:])
    assert late >= 10, "the frames of the second map come when it is joined"
    if not turned_first:
        assert followed(box_room, greys, begins_anew_after=5).poses == found.poses


@pytest.mark.slow
def test_a_join_that_the_map_contradicts_leaves_both_maps_as_they_are(box_room, box_walk, monkeypatch):
    tried = []

    def wrong(_, active, others):
        if not others or len(active.map.keyframes) < 5 or tried:
            return None
        of, pairs = others[0].map.keyframes[0], np.c_[np.arange(40), np.arange(40)]
        tried[:] = [Recognition(of, by, pairs, np.eye(4), of.T_camera_world, 1.0) for by in active.map.keyframes[-3:]]
        return others[0], list(tried)

    other = mirrored(box_room)
    greys = [*box_walk.grey[:30], *[BLACK] * 8, *(other.grey(T) for T in box_walk.poses[:30])]
    results = []
    for found in (lambda *_: None, wrong):
        monkeypatch.setattr(MapJoining, "found", found)
        each = followed(box_room, greys, begins_anew_after=5)
        results.append((each.poses, each.odometry.waiting))
        assert each.odometry.joined == 0 and each.odometry.undone == (1 if tried else 0)
    assert tried
    assert results[0] == results[1]


@pytest.mark.slow
@pytest.mark.parametrize("between", [0, 8])
def test_frames_of_another_place_stay_out_of_the_map(box_room, box_walk, between):
    other = mirrored(box_room)
    greys = [*box_walk.grey[:30], *[BLACK] * between, *(other.grey(T) for T in box_walk.poses[:25])]
    found = followed(box_room, greys, begins_anew_after=5)
    assert sorted(found.views) == list(range(30))
    assert found.odometry.joined == 0
    assert found.odometry.waiting == [list(range(30 + between, len(greys)))]


@pytest.mark.slow
def test_the_largest_map_is_the_runs_if_the_first_is_lost_at_its_start(box_room, box_walk):
    other = [np.ascontiguousarray(grey[::-1]) for grey in box_walk.grey[:9]]
    found = followed(box_room, [*other, *[BLACK] * 8, *box_walk.grey[:40]], begins_anew_after=5)
    assert sorted(found.views) == list(range(17, 57))
    assert found.odometry.waiting == [list(range(9))]


def test_a_map_keeps_its_observations_when_another_absorbs_it():
    rng = np.random.default_rng(0)
    lens = Lens.radial(300.0, 0.0, 320, 240)
    S = np.diag([2.0, 2.0, 2.0, 1.0]) @ exp_se3([0.3, -0.2, 0.5, 0.2, 0.4, -0.1])
    maps = []
    for first in (10, 0):  # the absorbed one has the earlier frames
        xyz = np.c_[rng.uniform(-1, 1, (40, 2)), rng.uniform(3, 5, 40)]
        poses = [exp_se3([-0.2 * i, 0, 0.05 * i, 0, 0.03 * i, 0]) for i in range(4)]
        landmarks = LandmarkMap(lens)
        ids = landmarks.new_ids(40)
        for i, T in enumerate(poses):
            pixels = lens.pixels(xyz @ T[:3, :3].T + T[:3, 3])
            landmarks.add_keyframe(
                Keyframe(first + i, T, np.zeros((240, 320), np.uint8), ids[i:], pixels[i:], lens.rays(pixels[i:]))
            )
        landmarks.xyz[ids], landmarks.known[ids] = xyz, True
        maps.append((landmarks, xyz))
    (own, own_xyz), (other, other_xyz) = maps
    before = [keyframe.T_camera_world.copy() for keyframe in other.keyframes]
    offset = own.absorb(other, S)
    assert [keyframe.number for keyframe in own.keyframes] == [0, 1, 2, 3, 10, 11, 12, 13]
    np.testing.assert_allclose(own.xyz[:40], own_xyz)
    np.testing.assert_allclose(own.xyz[offset : offset + 40], moved_points(S, other_xyz))
    for keyframe, T in zip(own.keyframes, before, strict=False):
        np.testing.assert_allclose(keyframe.T_camera_world, moved_pose(S, T), atol=1e-12)
    for k, keyframe in enumerate(own.keyframes):
        assert ray_errors(keyframe.T_camera_world, own.xyz[keyframe.ids], keyframe.rays).max() < 1e-9
        assert (own.first[keyframe.ids] <= k).all() and (own.last[keyframe.ids] >= k).all()
    # The first observation is that of the first keyframe of its own map.
    assert own.first[0] == 4 and own.first[offset] == 0


@pytest.mark.slow
def test_only_the_first_frames_of_a_recording_wait_and_not_those_of_a_camera(box_room, box_walk):
    """Both know their first map at the same frame. A recording has yet to see that it is no bad start."""
    first = {}
    for waits in (False, True):
        found = followed(box_room, box_walk.grey[:40], begins_anew_after=5, waits=waits)
        first[waits] = next(n for n, numbers in enumerate(found.brought) if numbers)
        assert list(found.views) == list(range(40))
    assert first[False] + 5 <= first[True] < 40


@pytest.mark.slow
@pytest.mark.parametrize("place", [1, 2, 3])
def test_the_map_of_a_place_by_size_is_chosen_when_all_frames_are_tracked(box_room, box_walk, place):
    """A place, nothing, and for longer another place."""
    greys = [*(mirrored(box_room).grey(T) for T in box_walk.poses[:45]), *[BLACK] * 8, *box_walk.grey]
    found = followed(box_room, greys, begins_anew_after=5, place=place)
    assert found.odometry.places == 2 and list(found.views) == found.brought[-1]
    if place == 3:
        assert not found.views and found.odometry.tracking is None
        return
    expected, others = [range(45), range(53, 113)][:: 1 if place == 2 else -1]
    assert list(found.views) == list(expected) and found.odometry.waiting == [list(others)]
    assert found.errors(dict(zip(expected, box_walk.poses, strict=False))).max() < 0.02
