from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from modp_ti.outputs.formats.exposure import write_exposures


def test_every_frame_is_written_with_its_exposure(tmp_path: Path) -> None:
    exposures = [np.arange(12).reshape(3, 4) / 7 + i for i in range(3)]
    write_exposures(tmp_path / "exposure.json", [0, 1, 2], [0.0, 0.1, 0.2], exposures, keyframes={1})
    frames = json.loads((tmp_path / "exposure.json").read_text())["frames"]
    assert [frame["index"] for frame in frames] == [0, 1, 2]
    assert [frame["timestamp"] for frame in frames] == [0.0, 0.1, 0.2]
    assert [frame["keyframe"] for frame in frames] == [False, True, False]
    for frame, exposure in zip(frames, exposures, strict=True):
        np.testing.assert_allclose(frame["matrix"], exposure, atol=1e-6)
