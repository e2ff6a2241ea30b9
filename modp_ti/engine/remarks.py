"""Remarks of a run about its map, for the user."""

from __future__ import annotations

from pipelines.companions.pace import CompletePace
from pipelines.online import OnlineMapper
from pipelines.pipeline import Pipeline


def remarks(pipeline: Pipeline) -> list[str]:
    """Return one-line remarks about a map after its last frame: what was left out, and what a budget took away."""
    said = []
    refused = [f"{count} {why}" for why, count in pipeline.refused.items() if count]
    if refused:
        said.append(f"frames that did not touch the map (mapping.gate): {', '.join(refused)}")
    if isinstance(pipeline, OnlineMapper) and pipeline.paging.problem is not None:
        said.append(f"{pipeline.paging.problem}; what had no room was left out")
    if isinstance(pipeline, OnlineMapper) and isinstance(pipeline.pace, CompletePace):
        optimise, plan = pipeline.settings.optimise, pipeline.pace.plan(0, *pipeline.counts)
        if plan.steps < optimise.steps:
            said.append(
                f"the recording is long: its keyframes got about {plan.steps} instead of {optimise.steps} steps each "
                "(mapping.optimise.budget; --best has no limit)"
            )
    return said
