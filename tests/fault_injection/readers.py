"""Every reader as a function of bytes, for the fuzzer and for replaying the corpus.

For a reader with several files, the first byte selects the file. The only expected exceptions are InputError and its
equivalents in `pipelines` and the tracker server.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from threading import Event

import numpy as np

from modp_ti.files.errors import InputError
from tests.fault_injection.samples import CAPTURES, SAMPLES, write_sample

__all__ = ["READERS", "Reader", "import_readers", "seeds"]


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        name: The reader's name.
        sample: Name of its sample input.
        files: The sample's files, by number.
        read: Called with the path of the file that was written, inside the sample's folder.
    """

    name: str
    sample: str
    files: tuple[str, ...]
    read: Callable[[Path], object]

    def __call__(self, folder: Path, data: bytes) -> bool:
        """Read `data` in place of one of the files, and return whether it was accepted."""
        if len(self.files) > 1:
            number, data = (data[0] if data else 0) % len(self.files), data[1:]
        else:
            number = 0
        file = folder / self.files[number]
        before = file.read_bytes()
        file.write_bytes(data)
        try:
            self.read(file)
        except InputError:
            return False
        finally:
            file.write_bytes(before)
        return True


def _open(file: Path) -> None:
    """Open the tracker of the scene that the file belongs to."""
    from modp_ti.config.scene_file import load_scene
    from modp_ti.inputs.trackers import open_tracker

    folder = file.parent
    while not (folder / "scene.yaml").exists():
        folder = folder.parent
    open_tracker(load_scene(folder / "scene.yaml")).close()


def _scene(file: Path) -> None:
    from modp_ti.config.scene_file import load_scene

    load_scene(file)


def _tum(file: Path) -> None:
    from modp_ti.inputs.trackers.trajectory import read_trajectory_file
    from modp_ti.outputs.formats.trajectory import read_trajectory

    try:
        read_trajectory(file)
    except InputError:
        pass
    read_trajectory_file(file)


def _points(file: Path) -> None:
    from modp_ti.inputs.trackers.point_cloud import read_point_file

    read_point_file(file)


def _listing(file: Path) -> None:
    from modp_ti.inputs.sources.tum_rgbd import open_tum_rgbd

    open_tum_rgbd(file.parent)


def _aria(file: Path) -> None:
    from modp_ti.inputs.trackers import aria_mps

    if file.name == "closed_loop_trajectory.csv":
        aria_mps.read_device_trajectory(file, open_loop=False)
    elif file.suffix == ".jsonl":
        aria_mps.read_calibration(file, "camera-rgb")
    elif file.name == "semidense_points.csv.gz":
        aria_mps.read_points(file, "g1", 0.005, 0.05)
    else:
        aria_mps.read_observations(file, np.arange(40), -1.0, 1.0)


def _stella(file: Path) -> None:
    from modp_ti.inputs.trackers.stella_map import read_stella_map

    read_stella_map(file)


def _image(file: Path) -> None:
    from modp_ti.inputs.sources.image_header import focal_length_35mm
    from modp_ti.inputs.sources.listed_images import ListedImages
    from modp_ti.inputs.sources.masks import read_vignette

    images = ListedImages(file.parent, [file.name], [0.0])
    focal_length_35mm(file)
    try:
        read_vignette(file)
    except InputError:
        pass
    size = images.size(file.name)
    assert images.read(file.name).shape[1::-1] == size


def _container(file: Path) -> None:
    from modp_ti.inputs.sources.video_container import missing_bytes

    missing_bytes(file)


def _video(file: Path) -> None:
    from modp_ti.inputs.sources.video_file import VideoFile

    video = VideoFile(file)
    video.read(video.names[-1])
    video.read(video.names[0])
    video.close()


def _run(file: Path) -> None:
    from modp_ti.outputs.formats.exposure import read_exposures
    from modp_ti.outputs.formats.keyframe_masks import read_masks
    from modp_ti.outputs.formats.scores_csv import read_scores
    from modp_ti.outputs.playback.finished_run import open_run

    folder = next(parent for parent in file.parents if parent.name == "out")
    if file.name == "exposure.json":
        read_exposures(file)
    elif file.name == "scores.csv":
        read_scores(file)
    elif file.parent.name == "masks":
        read_masks(file.parent)
    else:
        open_run(folder)


def _splats(file: Path) -> None:
    from modp_ti.outputs.formats.splats_ply import read_splats

    read_splats(file)


def _weights(file: Path) -> None:
    from pipelines.torch_checkpoint import read_checkpoint

    try:
        read_checkpoint(file)
    except ValueError as error:
        raise InputError(str(error)) from None


class _Wire(socket.socket):
    """A socket that has received a file's content and whose sender has disconnected."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def recv(self, size: int) -> bytes:
        part = self._data[self._at : self._at + size]
        self._at += len(part)
        return part

    def settimeout(self, seconds: float | None) -> None: ...

    def close(self) -> None: ...


def _tracker_server(file: Path) -> None:
    """Run a whole conversation, up to what is passed to the mapper."""
    from modp_ti.config.settings import SourceSettings
    from modp_ti.inputs.tracker_server import messages
    from modp_ti.inputs.tracker_server.connection import Connection, SenderGoneError
    from modp_ti.inputs.tracker_server.ordering import Ordering
    from modp_ti.inputs.tracker_server.spool import Spool

    connection = Connection(_Wire(file.read_bytes()), 1.0, Event())
    hello = spool = None
    ordering = Ordering()
    try:
        while True:
            kind, payload = connection.receive(hello)
            if kind is messages.Kind.END:
                break
            if kind is messages.Kind.HELLO:
                hello = messages.parse_hello(payload)
                hello.intrinsics.undistorter(1.0)
                spool = Spool(hello, SourceSettings())
            elif kind is messages.Kind.CORRECTION:
                ordering.add_correction(messages.parse_correction(payload))
            else:
                frame = messages.parse_frame(payload, kind)
                if kind is messages.Kind.POSE:
                    ordering.add_pose(frame)
                else:
                    ordering.require_next(frame)
                    spool.add(frame)
                    ordering.add_frame(frame)
            for _ in ordering.ready():
                pass
        ordering.close()
    except (messages.ProtocolError, SenderGoneError) as error:
        raise InputError(str(error)) from None
    finally:
        if spool is not None:
            spool.close()


RUN_FILES = (
    *("out/trajectory.txt", "out/frames.json", "out/exposure.json", "out/scores.csv", "out/masks/000000.png"),
    *(f"out/colmap/{stem}.bin" for stem in ("cameras", "images", "points3D")),
)

READERS: dict[str, Reader] = {
    reader.name: reader
    for reader in (
        Reader("scene", "scene", ("scene.yaml",), _scene),
        Reader("colmap", "colmap", SAMPLES["colmap"][0].files, _open),
        Reader("colmap_text", "colmap_text", SAMPLES["colmap_text"][0].files, _open),
        Reader("transforms", "transforms", ("transforms.json",), _open),
        Reader("tum", "tum", ("trajectory.txt",), _tum),
        Reader("points", "ply", ("points.ply",), _points),
        Reader("listing", "tum_rgbd", ("rgb.txt",), _listing),
        Reader("matrices", "replica", ("traj.txt",), _open),
        Reader("matrices_per_line", "matrices", ("poses.txt",), _open),
        Reader("tanksandtemples", "tanksandtemples", ("scene.log",), _open),
        Reader("modp", "modp", SAMPLES["modp"][0].files, _open),
        Reader("aria", "aria", SAMPLES["aria"][0].files, _aria),
        Reader("stella_vslam", "stella_vslam", ("map.msg",), _stella),
        Reader("image", "image", SAMPLES["image"][0].files, _image),
        Reader("video_container", "video", ("room.mp4",), _container),
        Reader("video", "video", ("room.mp4",), _video),
        Reader("splats", "run", ("out/splats.ply",), _splats),
        Reader("run", "run", RUN_FILES, _run),
        Reader("weights", "weights", ("older.pth", "weights.pth"), _weights),
        *(Reader(kind, kind, SAMPLES[kind][0].files, _open) for kind in CAPTURES),
        # Those of sqlite3 are larger than what the fuzzer tries.
        *(
            Reader(f"bag_{form}", f"bag_{form}", SAMPLES[f"bag_{form}"][0].files, _open)
            for form in ("ros1", "mcap", "depth")
        ),
        Reader("tracker_server", "tracker_server", ("wire",), _tracker_server),
    )
}


def import_readers() -> None:
    """Import every module that the readers use, once for all forked processes."""
    kinds = ("aria", "bag", "captures", "colmap", "data_sets", "matrices", "modp", "stella_vslam", "transforms", "tum")
    for name in (
        *(
            "config.scene_file",
            "outputs.formats.exposure",
            "outputs.formats.scores_csv",
            "outputs.formats.splats_ply",
            "outputs.formats.trajectory",
        ),
        *(
            "outputs.playback.finished_run",
            "inputs.sources.image_header",
            "inputs.sources.tum_rgbd",
            "inputs.sources.video_decoder",
            "inputs.sources.masks",
        ),
        *(f"inputs.trackers.{kind}" for kind in kinds),
        "inputs.captures.images",
        "inputs.tracker_server",
    ):
        import_module(f"modp_ti.{name}")
    import_module("pipelines.torch_checkpoint")


def seeds(reader: Reader, folder: Path) -> list[bytes]:
    """Write the reader's sample to a new folder, and return its files in the fuzzer's form."""
    write_sample(reader.sample, folder)
    contents = [(folder / name).read_bytes() for name in reader.files]
    return contents if len(contents) == 1 else [bytes([n]) + content for n, content in enumerate(contents)]
