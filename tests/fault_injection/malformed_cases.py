"""The malformed inputs: which file of each reader is corrupted, and how."""

from __future__ import annotations

from dataclasses import dataclass

from tests.fault_injection.corrupted_bags import CORRUPTED_BAGS
from tests.fault_injection.corrupted_captures import CAPTURES
from tests.fault_injection.corrupted_media import IMAGES, MASK, PATH, RUN, VIDEO
from tests.fault_injection.corrupted_trackers import (
    ARIA,
    COLMAP,
    COLMAP_TEXT,
    MATRICES,
    MODP,
    ORBSLAM3,
    PLY,
    REPLICA,
    SCENE,
    SEVENSCENES,
    STELLA,
    TANKSANDTEMPLES,
    TRANSFORMS,
    TUM,
    TUM_RGBD,
)
from tests.fault_injection.corruptions import ANYWHERE, TEXT, Corruption
from tests.fault_injection.samples import SAMPLES
from tests.fault_injection.small_bag import BAGS

__all__ = ["CASES", "Case"]


@dataclass(frozen=True)
class Case:
    """A malformed input.

    Attributes:
        reader: Name of the reader.
        file: The corrupted file, relative to the sample's folder.
        name: Name of the corruption.
        corrupt: Called with the file's path.
        arguments: Arguments of `modp-ti`.
    """

    reader: str
    file: str
    name: str
    corrupt: Corruption
    arguments: tuple[str, ...]


def _cases() -> list[Case]:
    cases: list[Case] = []

    def add(
        reader: str, file: str, corruptions: dict[str, Corruption], arguments: tuple[str, ...] | None = None
    ) -> None:
        cases.extend(
            Case(reader, file, name, corrupt, arguments or SAMPLES[reader][0].arguments)
            for name, corrupt in corruptions.items()
        )

    def anything(*without: str) -> dict[str, Corruption]:
        return {name: corrupt for name, corrupt in ANYWHERE.items() if name not in without}

    add("scene", "scene.yaml", anything() | TEXT | SCENE)
    for file, corruptions in COLMAP_TEXT.items():
        without = {"sparse/0/images.txt": ("cut in half",), "sparse/0/points3D.txt": ("cut in half",)}.get(file, ())
        add("colmap_text", file, anything(*without, *_of_posed_alone(file)) | corruptions)
    for file, corruptions in COLMAP.items():
        add("colmap", file, anything(*_of_posed_alone(file)) | corruptions)
    add("transforms", "transforms.json", anything() | TEXT | TRANSFORMS)
    for file, corruptions in TUM.items():
        left_out = ("NaN in a row", "infinity in a row") if file == "points.txt" else ()
        add("tum", file, anything() | TEXT | {name: c for name, c in corruptions.items() if name not in left_out})
    add("ply", "points.ply", anything() | PLY)
    add("orbslam3", "CameraTrajectory.txt", anything() | TEXT | ORBSLAM3)
    add("tum_rgbd", "rgb.txt", anything("cut in half") | TEXT | TUM_RGBD)
    add("matrices", "poses.txt", anything() | TEXT | MATRICES)
    add("tanksandtemples", "scene.log", anything("a link to itself") | TEXT | TANKSANDTEMPLES)
    add("replica", "traj.txt", anything() | TEXT | REPLICA)
    # Corruptions that have the same effect as a missing file.
    unseen = ("missing", "a folder", "a link to itself", "a pipe", "a device")
    add("sevenscenes", "seq/frame-000001.pose.txt", anything(*unseen) | TEXT | SEVENSCENES)
    add("modp", "trajectory.json", anything() | TEXT | MODP["trajectory.json"])
    for file in ("point_cloud/point_cloud_1.txt", "point_cloud/point_cloud_2.npy"):
        add("modp", file, anything("missing", "empty") | MODP[file])
    for file, corruptions in ARIA.items():
        # A row cut in the middle of its last number is still a valid row.
        cut = ("cut in half",) if file.endswith("observations.csv") else ()
        add("aria", file, anything(*cut, *(unseen if file.startswith("semidense") else ())) | corruptions)
    add("stella_vslam", "map.msg", anything("noise before it") | STELLA)
    for file, corruptions in IMAGES.items():
        add("image", file, anything("missing", "a folder", "a link to itself") | corruptions)
    for file, corruptions in MASK.items():
        add("mask", file, anything(*(("a link to itself",) if file.startswith("masks") else ())) | corruptions)
    add("video", "room.mp4", anything("noise before it") | VIDEO)
    for file, corruptions in RUN.items():
        add("run", file, anything() | corruptions)
    add("run", "path.txt", PATH, ("render", "out", "--path", "path.txt", "-o", "film.mp4", "--quiet"))
    for kind, files in CAPTURES.items():
        for file, corruptions in files.items():
            add(kind, file, anything(*_harmless(file)) | corruptions)
    for form, corruptions in CORRUPTED_BAGS.items():
        add(f"bag_{form}", BAGS.get(form, BAGS["mcap"]), anything() | corruptions)
    return cases


def _of_posed_alone(file: str) -> tuple[str, ...]:
    """Corruptions that leave a model of poses, for which points are triangulated."""
    return ("missing",) if "points3D" in file else ()


def _harmless(file: str) -> tuple[str, ...]:
    """Corruptions of a capture's file that have the effect of a missing one, or leave a valid one."""
    missing = ("missing", "a folder", "a link to itself", "a pipe", "a device")
    names = ("depth_00003.png", "frame_00003.json", "cameras/1733333.json", "depth/1.png", "pose/1.txt", ".pincam")
    if file.endswith((*names, "intrinsic_depth.txt")):
        return missing
    return ("cut in half", "noise before it") if file.endswith(".r3d") else ("cut in half",)


CASES = _cases()
