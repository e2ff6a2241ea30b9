"""A `Mapper` whose frames have several shapes. A process has room for one map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from modp_ti.engine.mapper import Mapper
from pipelines.settings import MappingSettings
from tests.pipelines.wall import frame


def cropped(whole: TrackedFrame, left: int, right: int) -> TrackedFrame:
    """The columns of a frame from `left` to before `right`, as the image of another camera."""
    camera = replace(whole.camera, cx=whole.camera.cx - left, width=right - left)
    points = replace(whole.points, pixels=whole.points.pixels - (left, 0))
    inside = camera.contains(points.pixels)
    points = SparsePoints(points.xyz[inside], points.pixels[inside], points.ids[inside])
    image = np.ascontiguousarray(whole.image[:, left:right])
    return replace(whole, image=image, camera=camera, points=points)


def test_frames_of_several_shapes_make_one_map(taichi_on_the_cpu: None) -> None:
    mapper = Mapper(64, 48, MappingSettings(optimise={"steps": 10}, densify={"warm_up": 2}), seed=1)
    frames = [cropped(frame(i), 20, 52) if i % 2 else frame(i) for i in range(6)]
    for each in frames:
        mapper.add(each)
    mapper.refine(20)
    for each, T in zip(frames, mapper.trajectory(), strict=True):
        render = np.clip(mapper.render(each.camera, T).colour, 0, 1)
        assert render.shape == each.image.shape
        assert -10 * np.log10(((render - each.image) ** 2).mean()) > 24
