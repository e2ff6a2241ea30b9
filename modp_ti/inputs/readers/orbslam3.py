"""Kind `orbslam3`: trajectories of ORB-SLAM2 and ORB-SLAM3, in TUM's format or, in nanoseconds, EuRoC's."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from modp_ti.inputs.posed_recording import PosedRecording
from modp_ti.inputs.reader import TrajectorySettings

# The trajectories of all frames and of the keyframes. A run with a name writes f_NAME.txt and kf_NAME.txt.
FRAMES, KEYFRAMES = "CameraTrajectory.txt", "KeyFrameTrajectory.txt"


class OrbSlam3Settings(TrajectorySettings):
    """A trajectory of ORB-SLAM2 or ORB-SLAM3, in TUM or EuRoC format."""

    kind: Literal["orbslam3"] = "orbslam3"
    path: Path | None = Field(
        default=None,
        description="the file or its folder; empty: `CameraTrajectory.txt` or `KeyFrameTrajectory.txt`, in the images' "
        "folder or next to it",
    )

    def add_poses(self, recording: PosedRecording) -> None:
        """Give images their pose in the trajectory of all frames or, if that is missing, of the keyframes."""
        names = (FRAMES, KEYFRAMES, "f_*.txt", "kf_*.txt")
        file = self.found(recording.source, names, f"ORB-SLAM3's {FRAMES} or {KEYFRAMES}")
        self.give_trajectory(recording, file)
        if file.name == KEYFRAMES or file.name.startswith("kf_"):
            recording.notes.append(
                f"{file.name} holds keyframes alone: give ORB-SLAM3's {FRAMES} to use the frames between them too"
            )
