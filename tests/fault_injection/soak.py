"""Soak test: maps a walk through the test room again and again, as one recording, and measures the memory."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from fields.frames.tracked_frame import TrackedFrame
from fields.runtime.backend import initialise
from modp_ti.engine.mapper import Mapper
from pipelines.settings import MappingSettings, OptimiseSettings
from tests.room import Room, RoomRecording, pinhole, walk

__all__ = ["Soak", "soak", "soak_table"]

WIDTH, HEIGHT = 80, 60
WALK = 56  # frames of the walk


@dataclass(frozen=True)
class Soak:
    """Result of a soak test.

    Attributes:
        frames: Number of mapped frames.
        keyframes: Number of keyframes at the end.
        gaussians: Number of Gaussians after each tenth of the frames.
        megabytes: Resident memory after each tenth of the frames [MB].
        kept: Memory that keyframes and frame records need after each tenth [MB]. It has to grow with the recording, and
            is computed rather than measured.
    """

    frames: int
    keyframes: int
    gaussians: list[int]
    megabytes: list[float]
    kept: list[float]

    @property
    def growth(self) -> float:
        """Growth of the memory after the first tenth [%]."""
        return 100.0 * (self.megabytes[-1] / self.megabytes[0] - 1.0)

    @property
    def growth_of_the_rest(self) -> float:
        """Growth of the memory without `kept` [%]."""
        first, last = (self.megabytes[i] - self.kept[i] for i in (0, -1))
        return 100.0 * (last / first - 1.0)


def soak(frames: int, memory: float | None, say: Callable[[str], None]) -> Soak:
    """Map the walk's frames back and forth until there are `frames` of them.

    Args:
        frames: Number of frames.
        memory: Memory limit of the map [GB] (`mapping.memory`), None for no limit.
        say: Called with progress lines.
    """
    initialise("cpu")
    walked = RoomRecording(Room(), pinhole(WIDTH, HEIGHT), walk(WALK)).frames()
    settings = MappingSettings(optimise=OptimiseSettings(steps=1), memory=memory)
    mapper = Mapper(WIDTH, HEIGHT, settings)
    megabytes: list[float] = []
    kept: list[float] = []
    gaussians: list[int] = []
    for frame in _there_and_back(walked, frames):
        mapper.add(frame)
        if (frame.index + 1) % max(frames // 10, 1) == 0:
            megabytes.append(_resident())
            kept.append(_must_be_kept(mapper) / 1e6)
            gaussians.append(len(mapper.pipeline.gaussians))
            say(f"{frame.index + 1} frames, {gaussians[-1]} Gaussians: {megabytes[-1]:.1f} MB")
    return Soak(frames, len(mapper.pipeline.keyframes), gaussians, megabytes, kept)


def _there_and_back(frames: list[TrackedFrame], count: int) -> Iterator[TrackedFrame]:
    turn = [*frames, *frames[-2:0:-1]]
    for index in range(count):
        frame = turn[index % len(turn)]
        yield replace(frame, index=index, timestamp=index / 10)


def _must_be_kept(mapper: Mapper) -> int:
    """Return the bytes of the keyframes' images and points, and of all frames' observations."""
    return mapper.pipeline.keyframes.nbytes + mapper.frames.points.nbytes


def _resident() -> float:
    """Return the resident memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def soak_table(result: Soak) -> str:
    """Return the result as a Markdown table."""
    return "\n".join(
        [
            "| soak | after a tenth | at the end |",
            "|---|---|---|",
            f"| frames | {result.frames // 10:,} | {result.frames:,} |",
            f"| keyframes | | {result.keyframes:,} |",
            f"| Gaussians | {result.gaussians[0]:,} | {result.gaussians[-1]:,} |",
            f"| memory of the process [MB] | {result.megabytes[0]:.1f} | {result.megabytes[-1]:.1f} |",
            f"| of that keyframes' images and frames' points [MB] | {result.kept[0]:.1f} | {result.kept[-1]:.1f} |",
            f"| growth | | {result.growth:+.2f} % |",
            f"| growth of the rest | | {result.growth_of_the_rest:+.2f} % |",
        ]
    )
