from __future__ import annotations

import json
from dataclasses import replace

import pytest

from fields.runtime.backend import initialise
from modp_ti.outputs.evaluation import FrameScore, MapVersion, StillScore, evaluate, score_frame, summary
from pipelines.online import OnlineMapper
from pipelines.settings import MappingSettings
from tests.pipelines.walked_wall import FRAMES, SETTINGS, still, walked, walker


def test_means_without_what_moves_are_given_if_it_was_masked() -> None:
    plain = [FrameScore(i, f"{i}", True, "online", 20.0, 0.9, None) for i in range(2)]
    masked = [
        replace(plain[0], still=StillScore(30.0, 0.98, 0.1)),
        replace(plain[1], still=StillScore(32.0, 0.96, 0.0)),
    ]
    assert not {"psnr_still", "ssim_still", "moving"} & set(summary(plain))
    means = summary(masked)
    assert {name: means[name] for name in summary(plain)} == summary(plain)
    assert (means["psnr_still"], means["ssim_still"], means["moving"]) == (31.0, 0.97, 0.05)
    json.dumps(means)


@pytest.mark.slow
@pytest.mark.usefixtures("taichi_on_the_cpu")
def test_a_frame_is_rendered_once_and_scored_with_and_without_what_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    initialise("cpu")
    mapper = OnlineMapper(MappingSettings(**SETTINGS, transients=True), 64, 48, seed=1)
    frames = [walked(i) for i in range(FRAMES)]
    for frame in frames:
        if frame.index % 4 != 2:
            mapper.process(frame)
    mapper.finish()
    poses = [mapper.keyframes.corrected(frame.index, frame.T_camera_world) for frame in frames]
    version = MapVersion(mapper.gaussians.to_numpy(), poses, [None] * FRAMES, 0)
    held_out = frames[2::4]
    plain = [score_frame(mapper, frame, poses[frame.index], "online")[0] for frame in held_out]
    of_the_wall = [score_frame(mapper, still(frame.index), poses[frame.index], "online")[0] for frame in held_out]

    renders, forward = [], mapper.renderer.forward
    monkeypatch.setattr(mapper.renderer, "forward", lambda *view: (renders.append(1), forward(*view)))
    scores = evaluate(mapper, held_out, {"online": version}, None, lambda *_: None)
    assert len(renders) == len(held_out) + len(mapper.keyframes.selected)
    assert [replace(score, still=None) for score in scores] == plain
    for score, wall, frame in zip(scores, of_the_wall, held_out, strict=True):
        assert score.still is not None
        if walker(frame.index).any():
            assert score.still.moving > 0.8 * walker(frame.index).mean()
            assert abs(score.still.psnr - wall.psnr) < 0.3 * (wall.psnr - score.psnr)
        else:
            assert (score.still.psnr, score.still.moving) == (score.psnr, 0.0)
