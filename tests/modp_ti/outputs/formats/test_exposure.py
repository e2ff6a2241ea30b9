from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from modp_ti.outputs.formats.exposure import read_exposures, write_exposures


def test_every_frame_is_written_with_its_exposure(tmp_path: Path) -> None:
    exposures = [np.arange(12).reshape(3, 4) / 7 + i for i in range(3)]
    write_exposures(tmp_path / "exposure.json", [0, 1, 2], [0.0, 0.1, 0.2], exposures, keyframes={1})
    frames = json.loads((tmp_path / "exposure.json").read_text())["frames"]
    assert [frame["index"] for frame in frames] == [0, 1, 2]
    assert [frame["timestamp"] for frame in frames] == [0.0, 0.1, 0.2]
    assert [frame["keyframe"] for frame in frames] == [False, True, False]
    for frame, exposure in zip(frames, exposures, strict=True):
        np.testing.assert_allclose(frame["matrix"], exposure, atol=1e-6)


def test_a_frame_without_an_exposure_is_written_with_the_identity(tmp_path: Path) -> None:
    write_exposures(tmp_path / "exposure.json", [0, 1], [0.0, 0.1], [None, np.full((3, 4), 0.5)], keyframes={1})
    found = read_exposures(tmp_path / "exposure.json")
    np.testing.assert_array_equal(found[0], np.eye(3, 4))
    np.testing.assert_array_equal(found[1], np.full((3, 4), 0.5))
