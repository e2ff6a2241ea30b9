"""The scale of a finished map by markers of a known size that its frames show."""

from __future__ import annotations

from collections import defaultdict

import cv2
import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.outputs.playback.finished_run import FinishedRun
from modp_ti.outputs.playback.map_renderer import eight_bits
from modp_ti.outputs.playback.run_frames import pictures
from modp_ti.outputs.progress import ProgressLine

# OpenCV's dictionaries by the names of the families.
FAMILIES = {
    "tag16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "tag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "tag36h10": cv2.aruco.DICT_APRILTAG_36h10,
    "tag36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "aruco": cv2.aruco.DICT_ARUCO_ORIGINAL,
    "4x4": cv2.aruco.DICT_4X4_1000,
    "5x5": cv2.aruco.DICT_5X5_1000,
    "6x6": cv2.aruco.DICT_6X6_1000,
    "7x7": cv2.aruco.DICT_7X7_1000,
}
# Most frames that are searched, evenly spaced.
SEARCHED = 200
# Reprojection error of a corner beyond which a view of it is not used [px], and fewest views that must agree.
AGREE, VIEWS = 1.5, 3
# Rounds in which the worst views are left out.
ROUNDS = 3


def marker_scale(run: FinishedRun, family: str, size: float, line: ProgressLine) -> tuple[float, float, int]:
    """Return the scale of a finished map by markers.

    The corners of each marker are triangulated by the map's poses, so that the map need not be sharp there.

    Args:
        run: The finished run.
        family: A key of FAMILIES.
        size: Edge of the markers' black square [m].
        line: Shows the progress.

    Returns:
        Metres per scene unit, the relative standard deviation of it, and the number of markers.

    Raises:
        InputError: If the images are gone, or no marker is seen well enough.
    """
    parameters = cv2.aruco.DetectorParameters()
    # Of drawn markers of 48 pixels, its edges are 0.2 % too long, those of the others 0.6 % too short or more.
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(FAMILIES[family]), parameters)
    places = run.spread(SEARCHED)
    seen: dict[int, list[tuple[NDArray[np.float64], NDArray[np.float64]]]] = defaultdict(list)
    found = line.through("looking for markers", pictures(run, places), len(places))
    for place, picture in zip(places, found, strict=True):
        corners, numbers, _ = detector.detectMarkers(np.ascontiguousarray(eight_bits(picture.image)[..., ::-1]))
        P = run.cameras[place].matrix() @ run.poses[place][:3]
        for number, four in zip([] if numbers is None else numbers.ravel().tolist(), corners, strict=True):
            seen[number].append((P, four.reshape(4, 2).astype(np.float64) + 0.5))  # OpenCV has 0 at a pixel's middle
    edges = [edge for views in seen.values() if (edge := _edges(views)) is not None]
    if not edges:
        raise InputError(
            f"{run.folder}: no marker of the family {family} is seen well by {VIEWS} frames or more; markers should be "
            "30 pixels wide at least, in frames as mapped"
        )
    lengths = np.concatenate(edges)
    mean = float(lengths.mean())
    # Four edges of one marker share its error.
    spread = float(lengths.std(ddof=1) / mean / np.sqrt(len(edges)))
    return size / mean, spread, len(edges)


def _edges(views: list[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> NDArray[np.float64] | None:
    """Lengths (4,) of a marker's edges, given projections (3, 4) and corners (4, 2) of views; None if few agree."""
    P, pixels = (np.stack(part) for part in zip(*views, strict=True))
    used = np.ones(len(P), dtype=bool)
    corners, error = np.zeros((4, 3)), np.full(len(P), np.inf)
    for _ in range(ROUNDS):
        if used.sum() < VIEWS:
            return None
        corners = np.stack([_triangulated(P[used], pixels[used, k]) for k in range(4)])
        projected = np.einsum("vij,kj->vki", P, np.c_[corners, np.ones(4)])
        error = np.linalg.norm(projected[..., :2] / projected[..., 2:] - pixels, axis=2).max(axis=1)
        used = error <= max(AGREE, float(np.median(error)))
    return np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1) if (error < AGREE).sum() >= VIEWS else None


def _triangulated(P: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Point (3,) at pixels (V, 2) of views with projections (V, 3, 4), of least squares in the image."""
    weight, x = np.ones(len(P)), np.zeros(4)
    for _ in range(3):  # the linear equations are those of the image once each is divided by its depth
        A = (pixels[..., None] * P[:, 2:3] - P[:, :2]) * weight[:, None, None]
        x = np.linalg.svd(A.reshape(-1, 4))[2][-1]
        weight = 1.0 / np.maximum(np.abs(P[:, 2] @ x / x[3]), 1e-12)
    return x[:3] / x[3]
