"""Kind `klt`: the built-in tracker, in `modp_ti.inputs.klt`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from modp_ti.inputs.protocol import Progress, Tracker
from modp_ti.inputs.reader import TrackerSettings

if TYPE_CHECKING:
    from modp_ti.inputs.source_settings import Scene

MOST_FOR_SFM = 400


class KltSettings(TrackerSettings):
    """The built-in tracker, which uses only the images."""

    follows_streams: ClassVar[bool] = True

    kind: Literal["klt"] = "klt"
    loops: bool = Field(
        default=False,
        description="close loops, drift of scale included, where the camera comes back after a long way. Needs "
        "`pip install 'modp-ti[loops]'`, and a second core",
    )
    maps: Literal["first", "largest", "all"] | Annotated[int, Field(ge=1)] = Field(
        default="first",
        description="which map is mapped, where the track is lost and what follows shows no place of what was before. "
        "`first`: the first one of 8 keyframes or 60 frames, while the images arrive; `largest`: that with the most "
        "frames, so that all images are tracked before the first is mapped; `all`: the largest, and then each other of "
        "8 keyframes or 60 frames in a run of its own, to `map-2`, `map-3`, ... in the output folder; a number: the "
        "map of this place by size",
    )

    fallback: Literal["sfm"] | None = Field(
        default=None,
        description=f"`sfm`: of a recording of at most {MOST_FOR_SFM} images of which less than 80 % could be placed, "
        "structure from motion is tried, and if it places more, they are mapped anew with it. `modp-ti run` on a "
        "recording sets it if no setting of `tracker` is given. Empty: none",
    )

    @property
    def place(self) -> int | None:
        """Place by size of the map that is mapped; None for the first one."""
        if isinstance(self.maps, int):
            return self.maps
        return None if self.maps == "first" else 1

    def second_choice(self, images: int) -> TrackerSettings | None:
        from modp_ti.inputs.readers.sfm import SfmSettings

        return SfmSettings() if self.fallback and images <= MOST_FOR_SFM else None

    def open(self, scene: Scene, progress: Progress | None = None) -> Tracker:
        """Open the tracker, in a process of its own where it keeps pace with its images."""
        if scene.tracks_beside_mapping:
            from modp_ti.inputs.tracking_process import TrackingProcess

            return TrackingProcess(scene, progress)
        from modp_ti.inputs.klt import open_klt

        return open_klt(scene.source, self, scene.seed, progress)
