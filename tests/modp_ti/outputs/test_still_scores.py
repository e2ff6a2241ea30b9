from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from modp_ti.outputs.evaluation import FrameScore, MapVersion, evaluate, summary
from modp_ti.outputs.still_scores import StillScore
from tests.pipelines.transients.walked_room import held_out, mapped, recording


@pytest.mark.slow
@pytest.mark.usefixtures("taichi_on_the_cpu")
def test_held_out_frames_are_scored_with_and_without_the_person() -> None:
    mapper = mapped(recording().walked, transients=True)
    frames = recording().walked
    poses = [mapper.keyframes.corrected(frame.index, frame.T_camera_world) for frame in frames]
    version = MapVersion(mapper.gaussians.to_numpy(), poses, [None] * len(frames), 0)
    renders = {}
    scores = evaluate(mapper, held_out(frames), {"online": version}, None, lambda _, f, r: renders.update({f.index: r}))
    for score in scores:
        frame, person = frames[score.index], recording().person[score.index]
        square = (renders[score.index] - frame.image) ** 2
        assert score.psnr == pytest.approx(-10 * np.log10(square.mean()), abs=0.05)
        assert score.still is not None
        if person.mean() > 0.05:
            around = ~binary_dilation(person, iterations=6)
            expected = -10 * np.log10(square[around].mean())
            assert score.still.psnr > score.psnr + 0.5 * (expected - score.psnr)
            assert person.mean() * 0.5 < score.still.moving < person.mean() + 0.2


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
