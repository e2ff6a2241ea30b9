"""The malformed inputs: of each reader's files, what is spoilt and how."""

from __future__ import annotations

from dataclasses import dataclass

from fault_injection.samples import SAMPLES
from fault_injection.spoils import ANYWHERE, TEXT, Spoil
from fault_injection.spoilt_media import IMAGES, MASK, PATH, RUN, VIDEO
from fault_injection.spoilt_trackers import (
    ARIA,
    COLMAP,
    COLMAP_TEXT,
    MODP,
    ORBSLAM3,
    PLY,
    REPLICA,
    SCENE,
    SEVENSCENES,
    STELLA,
    TRANSFORMS,
    TUM,
    TUM_RGBD,
)

__all__ = ["CASES", "Case"]


@dataclass(frozen=True)
class Case:
    """spoil: called with the path of `file`, relative to the sample's folder. arguments: of `modp-ti`."""

    reader: str
    file: str
    name: str
    spoil: Spoil
    arguments: tuple[str, ...]


def _cases() -> list[Case]:
    cases: list[Case] = []

    def add(reader: str, file: str, spoils: dict[str, Spoil], arguments: tuple[str, ...] | None = None) -> None:
        cases.extend(
            Case(reader, file, name, spoil, arguments or SAMPLES[reader][0].arguments) for name, spoil in spoils.items()
        )

    def anything(*without: str) -> dict[str, Spoil]:
        return {name: spoil for name, spoil in ANYWHERE.items() if name not in without}

    add("scene", "scene.yaml", anything() | TEXT | SCENE)
    for file, spoils in COLMAP_TEXT.items():
        without = {"sparse/0/images.txt": ("cut in half",), "sparse/0/points3D.txt": ("cut in half",)}.get(file, ())
        add("colmap_text", file, anything(*without) | spoils)
    for file, spoils in COLMAP.items():
        add("colmap", file, anything() | spoils)
    add("transforms", "transforms.json", anything() | TEXT | TRANSFORMS)
    for file, spoils in TUM.items():
        add("tum", file, anything() | TEXT | spoils)
    add("ply", "points.ply", anything() | PLY)
    add("orbslam3", "CameraTrajectory.txt", anything() | TEXT | ORBSLAM3)
    add("tum_rgbd", "rgb.txt", anything("cut in half") | TEXT | TUM_RGBD)
    add("replica", "traj.txt", anything() | TEXT | REPLICA)
    unseen = ("missing", "a folder", "a link to itself", "a pipe", "a device")  # what is as if it were not there
    add("sevenscenes", "seq/frame-000001.pose.txt", anything(*unseen) | TEXT | SEVENSCENES)
    add("modp", "trajectory.json", anything() | TEXT | MODP["trajectory.json"])
    for file in ("point_cloud/point_cloud_1.txt", "point_cloud/point_cloud_2.npy"):
        add("modp", file, anything("missing", "empty") | MODP[file])
    for file, spoils in ARIA.items():
        # A row that ends in the middle of its last number is a row.
        cut = ("cut in half",) if file.endswith("observations.csv") else ()
        add("aria", file, anything(*cut, *(unseen if file.startswith("semidense") else ())) | spoils)
    add("stella_vslam", "map.msg", anything("noise before it") | STELLA)
    for file, spoils in IMAGES.items():
        add("image", file, anything("missing", "a folder", "a link to itself") | spoils)
    for file, spoils in MASK.items():
        add("mask", file, anything(*(("a link to itself",) if file.startswith("masks") else ())) | spoils)
    add("video", "room.mp4", anything("noise before it") | VIDEO)
    for file, spoils in RUN.items():
        add("run", file, anything() | spoils)
    add("run", "path.txt", PATH, ("render", "out", "--path", "path.txt", "-o", "film.mp4", "--quiet"))
    return cases


CASES = _cases()
