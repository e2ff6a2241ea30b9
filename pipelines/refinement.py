"""Passes over a finished map: the last ones of the online loop, and post refinement (Section 4.7)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipelines.select.views import global_probabilities
from pipelines.settings import RefineSettings

if TYPE_CHECKING:
    from pipelines.online import OnlineMapper

# Factor on all rates at the end of `finish`. 0.2 and 0.1 differ by less than 0.1 dB on five recordings; 1 is 0.4 to
# 1.0 dB worse.
LAST_RATE = 0.2
# Exponent of error over best error in the draw of the refinement. On 140 images of courthouse, the worst 20 keyframes
# in a row end 0.1 dB below what they were after their own steps, and 0.4 without; held-out PSNR +0.01 dB.
RECOVERY = 4.0
GOLDEN_RATIO = (5**0.5 - 1) / 2
# Number of views up to which hidden Gaussians are removed before a refinement of limited time. More would take too much
# of it, and a realtime run has removed most of these Gaussians before.
MOST_SWEPT = 300

Schedule = Callable[[int], float | None]
"""Schedule of a refinement: returns the share of it that has passed before a step, None after the last step."""


@dataclass(frozen=True)
class LastPart:
    """A part of the passes of `finish`.

    Attributes:
        places: Places of its keyframes in the store.
        first: Number of views before it.
        end: Number of views after it.
        before: Number of views in the passes before its own.
    """

    places: NDArray[np.int64]
    first: int
    end: int
    before: int


def optimise_evenly(mapper: OnlineMapper, among: NDArray[np.int64], steps: int, views: int) -> float | None:
    """Optimise a map, but no poses, on keyframes that are drawn by error alone.

    Args:
        mapper: The mapper.
        among: Places (N,) of the keyframes in the store.
        steps: Number of steps.
        views: Number of keyframes per step.

    Returns:
        Mean PSNR of the last step; None if nothing was optimised.
    """
    if len(mapper.gaussians) == 0 or len(among) == 0:
        return None
    store, optimiser = mapper.keyframes, mapper.optimiser
    with mapper.stopwatch.measure("optimise"):
        for _ in range(steps):
            p = global_probabilities(store, mapper.settings.views.error_weight, 0.0, among)
            batch = [int(j) for j in mapper.rng.choice(among, views, p=p / p.sum())]
            optimiser.step(store, batch, optimiser.rates(store.scene_depth), pose_rate=0.0)
        return optimiser.settle() if steps > 0 else None


def _begin_passes(mapper: OnlineMapper, places: NDArray[np.int64]) -> None:
    """Let the companions look at keyframes before passes over them."""
    with mapper.stopwatch.measure("remove"):
        for companion in mapper.companions:
            companion.before_passes(places, mapper.near)


def finish(mapper: OnlineMapper, progress: Callable[[int, int, float], None] | None = None) -> float | None:
    """Finish the map after the last frame: passes over all keyframes, then a final pruning.

    While frames arrive, all rates are constant, and large enough for few steps. Here they decay, so that each
    Gaussian comes to rest. In a pass, every keyframe is a view once; views that follow each other are far apart.
    The pace may end the passes early. After an interruption, `finish` continues where it was.

    Args:
        mapper: The mapper after its last frame.
        progress: Called after every step with (views done, number of Gaussians, mean PSNR of the step's views).

    Returns:
        Mean PSNR of the last step; None if nothing was optimised.
    """
    if mapper.settled == 0:
        mapper.paging.plan()
    total = mapper.pace.last_views(len(mapper.keyframes)) if mapper.gaussian_count else 0
    psnr = None
    for part in _last_parts(mapper.paging.groups(), len(mapper.keyframes), total):
        if mapper.settled < part.end or total == 0:
            psnr = _settle(mapper, part, total, progress)
    return psnr


def _last_parts(groups: list[NDArray[np.int64]], count: int, total: int) -> list[LastPart]:
    """Divide the `total` views of `finish` into parts. Each pass over `count` keyframes visits their groups in turn."""
    if len(groups) == 1:
        return [LastPart(groups[0], 0, total, 0)]
    parts, first = [], 0
    for before in range(0, total, max(count, 1)):
        seen = 0
        for places in groups:
            seen += len(places)
            end = before + min(count, total - before) * seen // count
            parts.append(LastPart(places, first, end, before))
            first = end
    return parts


def _settle(
    mapper: OnlineMapper, part: LastPart, total: int, progress: Callable[[int, int, float], None] | None
) -> float | None:
    """Make a part of the passes of `finish`."""
    places, store, optimiser = part.places, mapper.keyframes, mapper.optimiser
    if mapper.settled == part.first:
        _begin_passes(mapper, places)
    views = np.resize(places[np.argsort(places * GOLDEN_RATIO % 1.0)], part.end - part.first)
    count, psnr = mapper.settings.views.per_step, None
    while mapper.settled < part.end:
        done = mapper.settled - part.first
        slower = LAST_RATE ** ((part.before + done * len(store) / len(places)) / total)
        rates = optimiser.rates(store.scene_depth, slower, slower, slower)
        batch = views[done : done + count].tolist()
        with mapper.stopwatch.measure("optimise"):
            psnr = optimiser.step(store, batch, rates, pose_rate=0.0)
        mapper.settled += len(batch)
        if progress is not None:
            progress(mapper.settled, mapper.gaussian_count, psnr)
    with mapper.stopwatch.measure("optimise"):
        psnr = optimiser.settle() if psnr is not None else None
    mapper.prune()
    return psnr


def in_steps(steps: int) -> Schedule:
    """Return the schedule of a refinement of so many steps. The first has the share 0, the last 1."""
    return lambda step: step / max(steps - 1, 1) if step < steps else None


def in_seconds(seconds: float, clock: Callable[[], float] = time.perf_counter) -> Schedule:
    """Return the schedule of a refinement that takes so long, by a clock, from its first step on [s]."""
    began: list[float] = []

    def share(_: int) -> float | None:
        now = clock()
        if not began:
            began.append(now)
        passed = (now - began[0]) / seconds
        return passed if passed < 1.0 else None

    return share


def decay(step: int, steps: int, final: float) -> float:
    """Exponential factor that decays from 1 at step 0 to `final` at the last of `steps` steps."""
    return float(final ** (step / max(steps - 1, 1)))


def refine(
    mapper: OnlineMapper,
    settings: RefineSettings,
    progress: Callable[[int, float], None] | None = None,
    done: int = 0,
    schedule: Schedule | None = None,
) -> None:
    """Optimise a finished map on draws from all keyframes, more from those of large error or far below their own best.

    After a share `settings.hold`, in which poses are refined as while the map grows, all rates decay. Before the first
    step, Gaussians that cover fewer than `settings.min_contribution` pixels in every keyframe are removed, but not from
    a map of many keyframes in a refinement by the clock. A map that is partly on disk is refined group after group of
    keyframes, each for its share of the steps.

    Args:
        mapper: Mapper after `finish`.
        settings: Settings of the refinement.
        progress: Called after every step with (steps done, mean PSNR of its views).
        done: Number of steps made before the mapper was restored. The remaining steps are the same as without the
            interruption.
        schedule: When the refinement ends, and how far the rates have decayed; None for what the settings say.

    Example:
        mapper.finish()
        modp_ti.refine(mapper, modp_ti.RefineSettings(steps=100))
    """
    with mapper.tenancy:
        store, views, poses = mapper.keyframes, mapper.settings.views, mapper.settings.poses
        if len(store) == 0 or mapper.gaussian_count == 0:
            return
        by_the_clock = schedule is not None or settings.seconds is not None
        if schedule is None:
            schedule = in_steps(settings.steps) if settings.seconds is None else in_seconds(settings.seconds)
        step, share = done, schedule(done)
        removes = settings.min_contribution > 0 and not (by_the_clock and len(store) > MOST_SWEPT)
        if not done and share is not None:
            _begin_passes(mapper, np.arange(len(store)))
        if removes and not done and share is not None:
            with mapper.stopwatch.measure("refine"):
                mapper.hidden.remove(settings.min_contribution, mapper.near)
        groups = mapper.paging.groups()
        ends = np.cumsum([0] + [len(places) for places in groups]) / len(store)  # of the groups' shares
        while share is not None:
            group = min(int(np.searchsorted(ends, share, side="right")) - 1, len(groups) - 1)
            passed = (share - ends[group]) / (ends[group + 1] - ends[group])
            decayed = max(passed - settings.hold, 0.0) / (1.0 - settings.hold)
            moves = poses.enabled and (settings.poses or passed < settings.hold)
            with mapper.stopwatch.measure("refine"):
                p = global_probabilities(store, views.error_weight, 0.0, groups[group], RECOVERY)
                batch = [int(j) for j in mapper.rng.choice(groups[group], settings.views, p=p)]
                slower = settings.position_decay**decayed
                rates = mapper.optimiser.rates(
                    store.scene_depth,
                    position_factor=slower,
                    scale_factor=settings.scale_decay**decayed,
                    other_factor=settings.rate_decay**decayed,
                )
                psnr = mapper.optimiser.step(store, batch, rates, poses.learning_rate * slower if moves else 0.0)
            step += 1
            if progress is not None:
                progress(step, psnr)
            share = schedule(step)
        with mapper.stopwatch.measure("refine"):
            mapper.optimiser.settle()
        mapper.prune()
