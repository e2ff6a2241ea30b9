"""Kind `sfm`: poses, points and cameras of bare images by structure from motion, kept for the next run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from fields.geometry.camera import PinholeCamera
from modp_ti.files import read_text
from modp_ti.files.atomic import replace_text
from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.files.run_folder import appearing
from modp_ti.inputs.opening import require_pinhole
from modp_ti.inputs.posed_recording import PosedRecording
from modp_ti.inputs.protocol import Progress, Tracker
from modp_ti.inputs.reader import TrackerSettings
from modp_ti.inputs.readers.colmap import pose_by_model
from modp_ti.inputs.replay import Unreadable
from modp_ti.inputs.sources import FrameReader, ImageSource, Intrinsics

if TYPE_CHECKING:
    from modp_ti.inputs.multiview.structure import MatchedImage
    from modp_ti.inputs.source_settings import Scene, SourceSettings

# The fingerprint of what a kept model was made of. A change of the method must change METHOD.
MADE_OF = "made_of.txt"
METHOD = "3"


class SfmSettings(TrackerSettings):
    """Structure from motion by pycolmap on the images alone; the model is kept in the output folder."""

    places_panoramas: ClassVar[bool] = True

    kind: Literal["sfm"] = "sfm"
    order: Literal["sequential", "unordered"] = Field(
        default="sequential",
        description="`sequential`: the images follow each other along a path, and each is matched with its neighbours "
        "and with images that look alike, which closes loops; `unordered`: only with images that look alike. Up to 60 "
        "images are all matched with each other",
    )
    mapper: Literal["incremental", "global"] = Field(
        default="incremental",
        description="`incremental`: place the images one after the other; `global`: all at once, which is faster for "
        "many images",
    )
    overlap: int = Field(default=10, ge=1, description="number of next images that an image is matched with")
    features: int = Field(default=4000, ge=100, description="largest number of features of an image")

    def open(self, scene: Scene, progress: Progress | None = None) -> Tracker:
        """Reconstruct the selected images, or take the model of an earlier run on the same images and settings.

        The faces of a panorama are placed together, as a rig. The model is in `sfm` in the output folder: a COLMAP
        model with a fingerprint. Fewer than three images that belong together raise InputError.
        """
        recording, folder = PosedRecording(scene.source, progress), scene.output / "sfm"
        images, names = recording.images, recording.selected
        if images.intrinsics is None:
            require_pinhole(images, scene.source, names[0])
        made_of = _fingerprint(images, scene.source, self, names, scene.seed)
        if _kept(folder) == made_of:
            recording.notes.append(f"structure from motion: {folder} is of these images and settings: used again")
        else:
            views, reader = [view for name in names for view in images.views(name)], FrameReader(images, scene.source)
            with appearing(folder.parent, (folder.name,)) as staged:
                _reconstruct(reader, views, self, staged / folder.name, scene.seed, progress or _silent)
                replace_text(staged / folder.name / MADE_OF, made_of)
        pose_by_model(recording, folder, upright=True)
        return recording.tracker()


def _reconstruct(
    reader: FrameReader, names: Sequence[str], tracker: SfmSettings, folder: Path, seed: int, progress: Progress
) -> None:
    """Write the model of the images to the folder."""
    from modp_ti.inputs.multiview.appearance import image_pairs
    from modp_ti.inputs.multiview.structure import reconstructed

    matched = list(_described(reader, names, tracker, progress))
    overlap = tracker.overlap if tracker.order == "sequential" else None
    mounts = reader.images.mounts
    pairs = image_pairs([image.features for image in matched], overlap, seed, len(mounts))
    model = reconstructed(matched, pairs, tracker.mapper, seed, progress, mounts)
    if model is None:
        raise InputError(
            f"{reader.images.path}: structure from motion could not join three of the {len(matched)} images: they need "
            "to show one scene with detail, from places apart; frames of a video are for tracker.kind=klt"
        )
    folder.mkdir()
    model.write_binary(str(folder))


def _described(
    reader: FrameReader, names: Sequence[str], tracker: SfmSettings, progress: Progress
) -> Iterator[MatchedImage]:
    """Find the features of the images. Damaged images are skipped."""
    from modp_ti.inputs.multiview.features import detect_features
    from modp_ti.inputs.multiview.structure import MatchedImage

    images, unreadable = reader.images, Unreadable()
    for number, name in enumerate(names):
        progress("finding features", number, len(names))
        try:
            raw = images.read(name)
        except UnreadableImageError as error:
            unreadable.add(name, error, len(names))
            continue
        features = detect_features(raw, tracker.features).within(reader.valid(name, raw))
        intrinsics = images.intrinsics or _guessed(raw.shape[1], raw.shape[0])
        yield MatchedImage(name, features, intrinsics, images.intrinsics is not None)
    progress("finding features", len(names), len(names))


def _guessed(width: int, height: int) -> Intrinsics:
    """A typical camera, to start from."""
    from modp_ti.inputs.klt.camera import TYPICAL_FOCAL

    focal = TYPICAL_FOCAL * max(width, height)
    return Intrinsics(PinholeCamera(focal, focal, width / 2, height / 2, width, height))


def _fingerprint(
    images: ImageSource, source: SourceSettings, tracker: SfmSettings, names: Sequence[str], seed: int
) -> str:
    """A hash of everything that the model depends on; of files, their sizes and times of change."""
    files = [images.path / name for name in names]
    stamps = [(file.stat().st_size, file.stat().st_mtime_ns) for file in files if file.is_file()]
    if not stamps:  # a video
        stamps = [(images.path.stat().st_size, images.path.stat().st_mtime_ns)]
    kept = {"kind", "intrinsics", "masks", "mask_colour", "mask_tolerance", "panorama"}
    chosen = source.model_dump(mode="json", include=kept)
    content = [METHOD, list(names), stamps, chosen, tracker.model_dump(mode="json"), seed]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _kept(folder: Path) -> str | None:
    """The fingerprint of the model in the folder; None if there is none."""
    try:
        return read_text(folder / MADE_OF)
    except (OSError, UnicodeDecodeError):
        return None


def _silent(what: str, done: int, total: int) -> None:
    """Progress that nobody sees."""
