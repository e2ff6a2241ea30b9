"""Measures how a step's time grows with pixels and Gaussians, and a keyframe's with the number of earlier keyframes."""

from __future__ import annotations

import numpy as np

from benchmarks.scene import Size, add_gaussians, arrays, camera_of, noise_frame
from benchmarks.timing import milliseconds, seconds
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from fields.map.gaussians import GaussianField
from fields.map.keyframes import KeyframeStore
from fields.runtime.backend import initialise
from pipelines.online import OnlineMapper
from pipelines.optimise.adam import LearningRates
from pipelines.optimise.map_optimiser import MapOptimiser
from pipelines.render.renderer import Renderer
from pipelines.settings import DensifySettings, KeyframeSettings, LevelSettings, MappingSettings, OptimiseSettings

__all__ = ["PIXELS", "measure_frames", "measure_growth"]

# (width, height, Gaussians in view, Gaussians behind the camera). Each group varies one quantity.
PIXELS = [(320, 240, 100_000, 0), (640, 480, 100_000, 0), (1280, 960, 100_000, 0)]
VISIBLE = [(640, 480, 25_000, 0), (640, 480, 100_000, 0), (640, 480, 400_000, 0)]
HIDDEN = [(640, 480, 50_000, 0), (640, 480, 50_000, 200_000), (640, 480, 50_000, 800_000)]
KEYFRAMES = (10, 100, 1000)
TIMED = 5  # number of keyframes that are timed at each of these


def measure_growth(device: str, threads: int, repeats: int) -> dict[str, list[dict[str, float]]]:
    """Return rows with the varied quantities and the time of a step [ms], for `pixels`, `visible` and `hidden`."""
    initialise(device, threads)
    gaussians = GaussianField()
    widest = max(PIXELS)
    renderer = Renderer(gaussians, widest[0], widest[1])
    optimiser = MapOptimiser(gaussians, renderer, MappingSettings())
    still = LearningRates(0.0, 0.0, 0.0, 0.0, 0.0)

    def row(width: int, height: int, visible: int, hidden: int) -> dict[str, float]:
        gaussians.remove(np.zeros(len(gaussians), dtype=bool))
        add_gaussians(gaussians, Size(width, height, visible))
        if hidden:
            add_gaussians(gaussians, Size(width, height, hidden), hidden=True)
        store = KeyframeStore()
        store.append(noise_frame(width, height))
        step = milliseconds(lambda: optimiser.step(store, [0], still, pose_rate=0.0), repeats)
        return {"pixels": width * height, "visible": visible, "hidden": hidden, "step": step}

    groups = {"pixels": PIXELS, "visible": VISIBLE, "hidden": HIDDEN}
    return {name: [row(*case) for case in cases] for name, cases in groups.items()}


def measure_frames(device: str, threads: int) -> list[dict[str, float]]:
    """Return the time of a keyframe with 5 steps [ms] by the number of earlier keyframes, in the same map."""
    initialise(device, threads)
    width, height = 320, 240
    settings = MappingSettings(
        sh_degree=0,
        keyframes=KeyframeSettings(max_gap=1),
        densify=DensifySettings(pixels=0),
        levels=LevelSettings(probabilities=(1.0,)),
        optimise=OptimiseSettings(steps=5),
    )
    mapper = OnlineMapper(settings, width, height)
    mapper.compile()
    add_gaussians(mapper.gaussians, Size(width, height, 10_000))
    camera = camera_of(width, height)
    xyz = arrays(Size(width, height, 300), seed=2)["position"]
    image = noise_frame(width, height).image

    def frame(number: int) -> TrackedFrame:
        T = np.eye(4)
        T[0, 3] = 0.01 * np.sin(number)
        pixels = camera.project(xyz + T[:3, 3])
        seen = camera.contains(pixels)
        points = SparsePoints(xyz[seen], pixels[seen], np.flatnonzero(seen))
        # Shifted, because the mapper rejects repeated images.
        made = TrackedFrame(2 * number, 0.0, str(number), np.roll(image, number, axis=1), camera, T, points)
        _ = made.pyramid  # as prefetching does
        return made

    rows = []
    for wanted in KEYFRAMES:
        while len(mapper.keyframes) < wanted:
            mapper.keyframes.append(frame(len(mapper.keyframes))).error = 0.03
        times = []
        for _ in range(TIMED + 1):
            next_frame = frame(len(mapper.keyframes))
            times.append(seconds(lambda next_frame=next_frame: mapper.process(next_frame)))
            assert len(mapper.keyframes) == next_frame.index // 2 + 1, "the frames are made to be keyframes"
        rows.append({"keyframes": wanted, "frame": 1e3 * float(np.median(times[1:]))})
    return rows
