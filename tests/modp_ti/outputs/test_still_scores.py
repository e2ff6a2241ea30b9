from __future__ import annotations

import json
from dataclasses import replace

from modp_ti.outputs.evaluation import FrameScore, summary
from modp_ti.outputs.still_scores import StillScore


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
