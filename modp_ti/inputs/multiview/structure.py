"""Structure from motion with pycolmap: poses, points and cameras of images from their features."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from fields.geometry.se3 import inverse_se3
from modp_ti.inputs.multiview.features import Features
from modp_ti.inputs.multiview.reprojection import estimated
from modp_ti.inputs.protocol import Progress
from modp_ti.inputs.sources.undistortion import Intrinsics

if TYPE_CHECKING:
    from modp_ti.files.quiet_pycolmap import pycolmap

# Pairs that are matched between two reports of the progress.
BATCH = 100
# A model of fewer images is none.
FEWEST_IMAGES = 3


@dataclass(frozen=True)
class MatchedImage:
    """An image to be placed.

    Attributes:
        name: Its name.
        features: Its features, in pixels of the stored image.
        intrinsics: Its camera.
        known: Whether the camera is known. Otherwise it is a guess of the focal length, which is refined together with
            a radial distortion.
    """

    name: str
    features: Features
    intrinsics: Intrinsics
    known: bool


def reconstructed(
    images: Sequence[MatchedImage],
    pairs: Sequence[tuple[int, int]],
    mapper: Literal["incremental", "global"],
    seed: int,
    progress: Progress,
    mounts: Sequence[NDArray[np.float64]] = (),
) -> pycolmap.Reconstruction | None:
    """Match images, and reconstruct their poses and points.

    Images with equal intrinsics share a camera. Two runs give the same result: the reconstruction uses one thread.

    Args:
        images: The images; those of a rig of C cameras in the order of its cameras, place after place.
        pairs: Pairs of their indices that are matched.
        mapper: Place the images one after the other, or all at once.
        seed: Seed of RANSAC.
        progress: Called while images are matched and placed.
        mounts: (C, 4, 4) T_camera_rig of the cameras of a rig, whose images keep their poses relative to each other.
            Fewer than two: every image has a pose of its own.

    Returns:
        The model with the most images, or None if fewer than three could be placed.
    """
    from modp_ti.files.quiet_pycolmap import pycolmap

    with tempfile.TemporaryDirectory(prefix="modp-ti-sfm-") as place:
        folder = Path(place)
        database = folder / "database.db"
        _write_features(database, images, mounts)
        _match(database, pairs, seed, progress)
        (folder / "models").mkdir()
        every_known = all(image.known for image in images)
        progress("placing the images", 0, len(images))
        if mapper == "global":
            models = estimated(_placed_together, database, folder, every_known, seed)
        else:
            models = estimated(_placed_in_turn, database, folder, every_known, seed, len(images), progress)
        progress("placing the images", len(images), len(images))
        best = max((models or {}).values(), key=pycolmap.Reconstruction.num_reg_images, default=None)
        if best is None or best.num_reg_images() < FEWEST_IMAGES:
            return None
        for image in best.images.values():
            image.name = images[int(image.name)].name
        return best


def _write_features(path: Path, images: Sequence[MatchedImage], mounts: Sequence[NDArray[np.float64]]) -> None:
    from modp_ti.files.quiet_pycolmap import pycolmap

    count = max(1, len(mounts))
    rigs: dict[Intrinsics, tuple[int, list[pycolmap.Camera]]] = {}
    with pycolmap.Database.open(path) as database:
        for first in range(0, len(images), count):
            views = images[first : first + count]
            if views[0].intrinsics not in rigs:
                rigs[views[0].intrinsics] = _write_rig(database, views, mounts)
            rig_id, cameras = rigs[views[0].intrinsics]
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            for number, (image, camera) in enumerate(zip(views, cameras, strict=True), first):
                # Numbers instead of names, which may hold blanks: these separate the names in a list of pairs.
                record = pycolmap.Image(name=str(number), camera_id=camera.camera_id)
                record.image_id = database.write_image(record)
                frame.add_data_id(record.data_id)
                database.write_keypoints(record.image_id, image.features.pixels.astype(np.float32))
                described = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, image.features.descriptors)
                database.write_descriptors(record.image_id, described)
            database.write_frame(frame)


def _write_rig(
    database: pycolmap.Database, views: Sequence[MatchedImage], mounts: Sequence[NDArray[np.float64]]
) -> tuple[int, list[pycolmap.Camera]]:
    """Write the rig of one camera, or that of `mounts`. Returns its number and its cameras."""
    from modp_ti.files.quiet_pycolmap import pycolmap

    rig, cameras = pycolmap.Rig(), []
    for number, image in enumerate(views):
        camera = _camera(image.intrinsics, image.known)
        camera.camera_id = database.write_camera(camera)
        cameras.append(camera)
        if number == 0:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, pycolmap.Rigid3d((mounts[number] @ inverse_se3(mounts[0]))[:3]))
    return database.write_rig(rig), cameras


def _camera(intrinsics: Intrinsics, known: bool) -> pycolmap.Camera:
    """The camera in COLMAP's model."""
    from modp_ti.files.quiet_pycolmap import pycolmap

    pinhole, lens = intrinsics.camera, intrinsics.distortion
    size = {"width": pinhole.width, "height": pinhole.height}
    if not known:
        return pycolmap.Camera(model="SIMPLE_RADIAL", params=[pinhole.fx, pinhole.cx, pinhole.cy, 0.0], **size)
    first = [pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy]
    n = [*lens.numerator, 0.0, 0.0, 0.0, 0.0]
    d = [*lens.denominator, 0.0, 0.0, 0.0]
    if lens.fisheye:
        camera = pycolmap.Camera(model="OPENCV_FISHEYE", params=[*first, *n[:4]], **size)
    else:
        params = [*first, n[0], n[1], *lens.tangential, n[2], *d[:3]]
        camera = pycolmap.Camera(model="FULL_OPENCV", params=params, **size)
    camera.has_prior_focal_length = True
    return camera


def _match(database: Path, pairs: Sequence[tuple[int, int]], seed: int, progress: Progress) -> None:
    """Match pairs of images and verify their geometry."""
    from modp_ti.files.quiet_pycolmap import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    listed = database.with_name("pairs.txt")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = str(listed)
    for first in range(0, len(pairs), BATCH):
        progress("matching images", first, len(pairs))
        listed.write_text("".join(f"{a} {b}\n" for a, b in pairs[first : first + BATCH]))
        pycolmap.match_image_pairs(
            database, pairing_options=pairing, verification_options=verification, device=pycolmap.Device.cpu
        )
    progress("matching images", len(pairs), len(pairs))


def _placed_in_turn(
    database: Path, folder: Path, every_known: bool, seed: int, count: int, progress: Progress
) -> dict[int, pycolmap.Reconstruction]:
    from modp_ti.files.quiet_pycolmap import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    options.num_threads = 1
    options.min_model_size = FEWEST_IMAGES
    options.extract_colors = False
    if every_known:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.ba_refine_sensor_from_rig = False
    placed = 2

    def next_image() -> None:
        nonlocal placed
        placed += 1
        progress("placing the images", min(placed, count - 1), count)

    return pycolmap.incremental_mapping(database, folder, folder / "models", options, next_image_callback=next_image)


def _placed_together(database: Path, folder: Path, every_known: bool, seed: int) -> dict[int, pycolmap.Reconstruction]:
    from modp_ti.files.quiet_pycolmap import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = options.mapper.random_seed = seed
    options.num_threads = options.mapper.num_threads = 1
    options.min_model_size = FEWEST_IMAGES
    if every_known:
        adjustment = options.mapper.bundle_adjustment
        adjustment.refine_focal_length = adjustment.refine_extra_params = False
    options.mapper.refine_sensor_from_rig = False
    return pycolmap.global_mapping(database, folder, folder / "models", options)
