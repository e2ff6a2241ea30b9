"""`cleaned`: which Gaussians of a map stay when its faults are removed, as far as held-out frames allow it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fields.frames.tracked_frame import TrackedFrame
from modp_ti.engine.mapper import Mapper
from modp_ti.inputs.protocol import Tracker
from modp_ti.outputs.evaluation import MapVersion, keyframe_psnr, score_frame
from pipelines.online import OnlineMapper
from pipelines.whole.cleaning import faults, harmless

# Loss of held-out quality that removing faults may cost [dB].
LOSS = 0.05
# Frames that it is measured on, evenly spaced.
MEASURED = 32


def thinned(frames: Sequence[int]) -> list[int]:
    """Return at most `MEASURED` of the frames, evenly spaced."""
    return list(frames[:: -(-len(frames) // MEASURED) or 1])


def cleaned(
    mapper: OnlineMapper, held_out: Sequence[tuple[TrackedFrame, NDArray[np.float64]]]
) -> tuple[NDArray[np.bool_], dict[str, Any]]:
    """Remove the faults of a finished map, see `pipelines.whole.cleaning`, but what would cost more than `LOSS`.

    Args:
        mapper: The map, which is in memory as a whole. It holds what stays afterwards.
        held_out: Frames and T_camera_world (4, 4) to measure quality on. Without any, it is measured on keyframes.

    Returns:
        Which Gaussians stay (N,); and `removed`, their numbers by kind, `kept`, `held_out`, whether there were such
        frames, and the PSNR `before` and `after` [dB].
    """
    state, keyframes = mapper.gaussians.to_numpy(), mapper.keyframes
    views = [list(keyframes)[index] for index in thinned(range(len(keyframes)))]

    def score(kept: NDArray[np.bool_]) -> float:
        mapper.gaussians.load({name: values[kept] for name, values in state.items()})
        scores = [
            score_frame(mapper, frame, T, "", None, keyframes.exposure_at(frame.index))[0].psnr for frame, T in held_out
        ]
        return float(np.mean(scores or [keyframe_psnr(mapper, view) for view in views]))

    taken, before, after = harmless(*faults(mapper), score, LOSS)
    kept = ~np.any(list(taken.values()), axis=0)
    mapper.gaussians.load({name: values[kept] for name, values in state.items()})
    return kept, {
        "removed": {kind: int(mask.sum()) for kind, mask in taken.items()},
        "kept": int(kept.sum()),
        "held_out": bool(held_out),
        "before": round(before, 4),
        "after": round(after, 4),
    }


def cleaned_at_the_end(mapper: Mapper, tracker: Tracker, version: MapVersion) -> dict[str, Any] | None:
    """Remove the faults of the map of a run, and return what `cleaned` says; None if parts of it are on disk.

    Args:
        mapper: The mapper after the last frame.
        tracker: Reads held-out frames again.
        version: The map.
    """
    frames, online = mapper.frames, mapper.online
    if len(online.gaussians) < len(version.gaussians["position"]):
        return None
    held_out = set(thinned([index for index, held in zip(frames.index, frames.held_out, strict=True) if held]))
    poses = dict(zip(frames.index, version.trajectory, strict=True))
    again = frames.again(tracker) if held_out else ()
    return cleaned(online, [(frame, poses[frame.index]) for frame in again if frame.index in held_out])[1]


def said(entry: dict[str, Any]) -> str:
    """Return in words what `cleaned` has done."""
    removed = ", ".join(f"{count} {kind}" for kind, count in entry["removed"].items())
    return (
        f"removed {removed} of {entry['kept'] + sum(entry['removed'].values())}; "
        f"PSNR of {'held-out frames' if entry['held_out'] else 'keyframes'} "
        f"{entry['before']:.2f} dB before, {entry['after']:.2f} dB after"
    )
