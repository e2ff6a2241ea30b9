"""Kind `orbslam3`: trajectories of ORB-SLAM2 and ORB-SLAM3, in TUM's format or, in nanoseconds, EuRoC's."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from modp_ti.files.errors import InputError
from modp_ti.inputs.given_poses import found_file
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.reader import TrajectorySettings
from modp_ti.inputs.replay import ReplayedTracker
from modp_ti.inputs.timed_poses import replay_trajectory

if TYPE_CHECKING:
    from modp_ti.config.settings import SceneConfig

# The trajectories of all frames and of the keyframes. A run with a name writes f_NAME.txt and kf_NAME.txt.
FRAMES, KEYFRAMES = "CameraTrajectory.txt", "KeyFrameTrajectory.txt"


class OrbSlam3Settings(TrajectorySettings):
    """A trajectory that ORB-SLAM2 or ORB-SLAM3 wrote."""

    kind: Literal["orbslam3"] = Field(
        default="orbslam3", description="a trajectory of ORB-SLAM2 or ORB-SLAM3, in TUM or EuRoC format"
    )
    path: Path | None = Field(
        default=None,
        description="the file or its folder; empty: `CameraTrajectory.txt` or `KeyFrameTrajectory.txt`, in the images' "
        "folder or next to it",
    )

    def open(self, scene: SceneConfig, progress: Progress | None = None) -> ReplayedTracker:
        """Open the images that have a pose in CameraTrajectory.txt or, if that is missing, in KeyFrameTrajectory.txt.

        Frames without a pose are skipped and counted.
        """
        file = _found(self.path, scene.source.require_path())
        opened = replay_trajectory(file, scene.source, self, progress)
        if file.name == KEYFRAMES or file.name.startswith("kf_"):
            opened.notes.append(
                f"{file.name} holds keyframes alone: give ORB-SLAM3's {FRAMES} to use the frames between them too"
            )
        return opened


def _found(given: Path | None, images: Path) -> Path:
    if given is not None and given.is_dir() and not any((given / name).is_file() for name in (FRAMES, KEYFRAMES)):
        named = [*sorted(given.glob("f_*.txt")), *sorted(given.glob("kf_*.txt"))]
        if len(named) > 2:
            raise InputError(f"{given}: holds {len(named)} trajectories: name one of them in tracker.path")
        if named:
            return named[0]
    guesses = [folder / name for name in (FRAMES, KEYFRAMES) for folder in (images, images.parent)]
    return found_file(given, guesses, f"ORB-SLAM3's {FRAMES} or {KEYFRAMES}")
