"""Frames, renders and error maps, against what is computed pixel by pixel."""

from __future__ import annotations

import base64

import cv2
import matplotlib
import numpy as np
import pytest

from modp_ti.outputs.evaluation import FrameScore
from modp_ti.outputs.report.page import FULL_SCALE, Album, picked


def score(index: int, psnr: float, held_out: bool = True) -> FrameScore:
    return FrameScore(index, f"f{index}", held_out, "online", psnr, 0.9, None)


def test_the_worst_the_median_and_the_best_are_picked() -> None:
    psnr = np.random.default_rng(1).permutation(np.arange(20.0, 41.0))  # 21 frames; the median has 30 dB
    chosen = picked([score(i, p) for i, p in enumerate(psnr)])
    assert [s.psnr for s, _ in chosen[:3]] == [20.0, 21.0, 22.0]
    assert len(chosen) == 7
    assert {word: s.psnr for s, word in chosen if word} == {"worst": 20.0, "median": 30.0, "best": 40.0}
    assert [s.psnr for s, _ in chosen] == sorted(s.psnr for s, _ in chosen)


@pytest.mark.parametrize("count", range(9))
def test_of_few_frames_each_is_shown_once(count: int) -> None:
    chosen = picked([score(i, 20.0 + i) for i in range(count)])
    assert [s.index for s, _ in chosen] == list(range(count))[: len(chosen)] or count > 7
    assert len({s.index for s, _ in chosen}) == len(chosen) == min(count, 7)
    if count > 2:
        assert chosen[0][1] == "worst" and chosen[-1] == (score(count - 1, 19.0 + count), "best")


def test_held_out_frames_are_read_from_the_written_pairs(tmp_path) -> None:
    rng = np.random.default_rng(2)
    image, other = (cv2.resize(rng.random((2, 2, 3)).astype(np.float32), (1600, 1200)) for _ in range(2))
    render = 0.8 * image + 0.2 * other
    pair = np.round(np.hstack([image, render])[..., ::-1] * 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "000004.png"), pair)
    album = Album.of([False] * 4 + [True])
    album.keep(1, image, render)
    assert album.kept == {}, "pictures of held-out frames are on the disk already"
    (shown,) = album.comparisons([score(4, 25.0), score(1, 30.0, held_out=False)], tmp_path)
    assert shown.score.index == 4

    def decoded(uri: str) -> np.ndarray:
        data = np.frombuffer(base64.b64decode(uri.removeprefix("data:image/jpeg;base64,")), np.uint8)
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1].astype(float)
        assert decoded.shape == (360, 480, 3)
        return decoded

    image, render = (cv2.resize(one, (480, 360), interpolation=cv2.INTER_AREA) for one in (image, render))

    for uri, expected in ((shown.frame, image), (shown.render, render)):
        assert np.abs(decoded(uri) - 255 * expected).mean() < 3
    difference = np.clip(np.abs(image - render).mean(axis=2) / FULL_SCALE, 0, 1)
    expected = matplotlib.colormaps["inferno"](difference)[..., :3] * 255
    assert np.abs(decoded(shown.error) - expected).mean() < 8


def test_where_none_is_held_out_a_few_frames_are_kept() -> None:
    album = Album.of([False] * 100)
    for i in range(100):
        album.keep(i, np.full((8, 8, 3), i / 100, np.float32), np.zeros((8, 8, 3), np.float32))
    assert len(album.kept) == 7 and {0, 99} <= set(album.kept)
    shown = album.comparisons([score(i, 30.0 - i / 10, held_out=False) for i in range(100)], None)
    assert [s.score.index for s in shown] == sorted(album.kept, reverse=True)
    assert set(Album.of([False]).wanted) == {0}
