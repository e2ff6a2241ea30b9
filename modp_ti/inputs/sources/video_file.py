"""Source `video`: the frames of a video file, decoded with PyAV (FFmpeg) from the first to the last."""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError
from modp_ti.inputs.sources.image_header import MAX_IMAGE_PIXELS
from modp_ti.inputs.sources.orientation import AS_STORED, Turn
from modp_ti.inputs.sources.protocol import IMAGE_SUFFIXES, ImageSource
from modp_ti.inputs.sources.tone_mapping import PEAK, WHITE, ToneMapping, Transfer

if TYPE_CHECKING:
    import av

VIDEO_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts"),
    *(".wmv", ".flv", ".3gp", ".ogv", ".h264", ".h265", ".hevc", ".mjpg", ".mjpeg"),
    *(".gif", ".insv", ".lrv", ".qt", ".dav", ".y4m"),
)

# FFmpeg's names of the accepted formats: video containers, but not playlists, which refer to other files.
CONTAINERS = (
    "mov,matroska,webm,avi,mpeg,mpegts,mpegvideo,h264,hevc,vvc,m4v,mjpeg,asf,flv,ogg,"
    "ivf,obu,av1,dv,gxf,mxf,nut,rm,wtv,yuv4mpegpipe,gif,apng,dhav"
)
LIMITS = {"max_pixels": str(MAX_IMAGE_PIXELS)}
# Colour matrices by the number in H.273, as FFmpeg's filter numbers them. HDR with another matrix, or with none, is
# taken to have that of BT.2020.
MATRICES = {1: "ITU709", 5: "ITU601", 6: "ITU601"}


class VideoFile(ImageSource):
    """An `ImageSource` of a video file. Frame n, from 0, is called `<file stem>_<n, six digits>`.

    The file is decoded once when it is opened, because only that gives the number of frames and their times. Frames are
    turned as the file requests: phones store portrait videos in landscape. HDR is tone-mapped (`tone_mapping.py`).

    A frame is the same whenever it is read. Reading goes forward: an earlier frame takes decoding from the first frame
    on. Frames may be read from several threads.

    Args:
        path: The video file.
        fps: Frames per second, used if the container has no frame times.
        stop: Number of frames to use; all if None.

    Raises:
        InputError: If the file is missing, not a video, or has no frames.
    """

    def __init__(self, path: str | os.PathLike[str], fps: float = 30.0, stop: int | None = None) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise InputError(f"{self.path}: no such video file (source.path)")
        if not self.path.is_file():
            raise InputError(f"{self.path}: a video must be a file, this is a folder or a pipe (source.kind)")
        self._lock = Lock()
        self._form: _Form | None = None
        decoder = self._opened(in_threads=True)
        shown: list[float] = []
        first = None
        while (stop is None or len(shown) < stop) and decoder.advance():
            shown.append(decoder.shown)
            if len(shown) == 1:
                first, self._form = decoder.image(), decoder.form
        decoder.close()
        if first is None or self._form is None:
            raise self._useless()
        times, timed = _frame_times(np.array(shown), fps)
        super().__init__(self.path, [f"{self.path.stem}_{i:06d}" for i in range(len(shown))], times)
        height, width = first.shape[:2]
        self._size = (width, height)
        notes, form = decoder.notes, self._form
        if form.turn != AS_STORED:
            notes.append(
                f"asks to be {form.turn}, and is: its frames are {width}x{height}, and intrinsics are for that"
            )
        if form.transfer is not None:
            notes.append(
                f"is HDR ({form.transfer.name}, BT.2020): its colours are converted to BT.709, and {PEAK:g} cd/m2 "
                f"become a white of {WHITE:g} cd/m2 by the curve of BT.2390"
            )
        if form.interlaced:
            notes.append("is interlaced: convert it first, for example with `ffmpeg -i in -vf bwdif out.mp4`")
        for note in notes:
            self.add_note(f"{self.path} {note}")
        if not timed:
            self.add_note(f"{self.path} holds no frame times: frame n is taken to be of second n / {fps:g}")
        self._decoder = self._opened()

    def read(self, name: str) -> NDArray[np.uint8]:
        """Decode a frame (H, W, 3) uint8 RGB.

        Raises:
            InputError: If the frame cannot be decoded.
        """
        with self._lock:
            index = self._position[name]
            if index < self._decoder.index:
                self._decoder.close()
                self._decoder = self._opened()
            while self._decoder.index < index and self._decoder.advance():
                pass
            image = self._decoder.image() if self._decoder.index == index else None
        if image is None:
            raise InputError(f"{self.path}: frame {index} cannot be decoded (any more); was the file changed?")
        return image

    def close(self) -> None:
        """Close the file, once another thread that is reading from it has its frame."""
        with self._lock:
            self._decoder.close()

    def _opened(self, in_threads: bool = False) -> _Decoder:
        try:
            return _Decoder(self.path, in_threads, self._form)
        except OSError:
            raise self._useless() from None

    def _useless(self) -> InputError:
        if self.path.stat().st_size == 0:
            return InputError(f"{self.path}: the video file is empty")
        return InputError(
            f"{self.path}: no video that FFmpeg can read, or without a frame; if it is cut off, copy it again; or "
            "convert it, for example with `ffmpeg -i in -c:v libx264 out.mp4`"
        )


def is_video(path: Path) -> bool:
    """Whether FFmpeg finds a video in a file, whatever its suffix. A single picture is none."""
    try:
        if path.suffix.lower() in IMAGE_SUFFIXES:
            return False
        _Decoder(path, in_threads=False).close()
    except OSError:
        return False
    return True


def _frame_times(shown: NDArray[np.float64], fps: float) -> tuple[NDArray[np.float64], bool]:
    """Compute increasing frame times [s] from a container's time stamps [ms].

    Some containers have no time stamps for the last frames. Those follow at the median distance.

    Returns the times, and whether they come from the container rather than from `fps`.
    """
    falls = np.flatnonzero(np.diff(shown) <= 0)
    good = int(falls[0]) + 1 if len(falls) else len(shown)
    if good < max(len(shown) - 32, min(2, len(shown))):
        return np.arange(len(shown)) / fps, False
    times = shown / 1000.0
    distance = float(np.median(np.diff(times[:good]))) if good > 1 else 1.0 / fps
    times[good:] = times[good - 1] + distance * np.arange(1, len(shown) - good + 1)
    return times, True


@dataclass(frozen=True)
class _Form:
    """What all frames of a video have in common; the first frame tells. Frames of another size are scaled to it."""

    width: int
    height: int
    turn: Turn
    transfer: Transfer | None  # of HDR video
    interlaced: bool

    @classmethod
    def of(cls, frame: av.VideoFrame) -> _Form:
        transfer = next((each for each in Transfer if each.value == frame.color_trc), None)
        return cls(frame.width, frame.height, _turn(frame), transfer, frame.interlaced_frame)


def _turn(frame: av.VideoFrame) -> Turn:
    """How the display matrix turns a frame, to the nearest quarter turn."""
    try:
        # The stubs lack this key.
        matrix = frame.side_data["DISPLAYMATRIX"]  # pyright: ignore[reportGeneralTypeIssues]
        a, b, _, c, d, *_ = struct.unpack("=9i", bytes(matrix))
    except (KeyError, ValueError, struct.error):  # ValueError: the frame has other data, unknown to PyAV
        return AS_STORED
    mirrored = a * d - b * c < 0
    degrees = math.degrees(math.atan2(-b, -a) if mirrored else math.atan2(b, a))
    return Turn(round(degrees / 90) % 4, mirrored)


class _Decoder:
    """Decodes a video stream of a file, frame by frame: as FFmpeg does, a default one before others, then the largest.

    Args:
        path: The video file.
        in_threads: Decode in several threads. This is faster, but damaged parts look different each time.
        form: Size, turn and colours that all frames have; the first frame's if None.

    Raises:
        OSError: FFmpeg does not recognise the file as a video.
    """

    def __init__(self, path: Path, in_threads: bool, form: _Form | None = None) -> None:
        import av.error
        from av.stream import Disposition
        from av.video.reformatter import VideoReformatter

        self._errors = (av.error.FFmpegError, OSError, ValueError, ArithmeticError, MemoryError)
        options = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file", **LIMITS}
        try:
            self._container = av.open(f"file:{path}", options=options, metadata_errors="replace")
        except self._errors:
            raise OSError(str(path)) from None
        # A stream without a context is of a codec unknown to FFmpeg. Thumbnails do not count.
        streams = [
            stream
            for stream in self._container.streams.video
            if stream.codec_context is not None and not stream.disposition & Disposition.attached_pic
        ]
        if not streams:
            self._container.close()
            raise OSError(str(path))
        ranks = [(bool(each.disposition & Disposition.default), each.width * each.height) for each in streams]
        self._stream = streams[ranks.index(max(ranks))]
        self.notes: list[str] = []  # on the streams, and an error that ended the file
        if len(streams) > 1:
            sizes = ", ".join(f"{each.width}x{each.height}" for each in streams)
            number = streams.index(self._stream) + 1
            self.notes.append(f"holds {len(streams)} video streams ({sizes}): number {number} is used")
        self._stream.codec_context.options = LIMITS
        if in_threads:
            self._stream.thread_type = "AUTO"
        else:
            self._stream.codec_context.thread_count = 1
        self._unit = float(self._stream.time_base or 0)  # [s]
        self._start = self._stream.start_time or 0
        self._reformatter = VideoReformatter()  # reused, because a new one computes its tables again
        self._tones: ToneMapping | None = None
        self._frame: av.VideoFrame | None = None
        self._frames = self._decoded()
        self.form = form  # set by the first image, if not given
        self.index = -1  # of the frame that was decoded last

    @property
    def shown(self) -> float:
        """Time stamp of the current frame [ms] from the start of the stream; 0 if the container has none."""
        if self._frame is None or self._frame.pts is None:
            return 0.0
        return (self._frame.pts - self._start) * self._unit * 1000.0

    def advance(self) -> bool:
        """Decode the next frame. Returns False at the end."""
        self._frame = next(self._frames, None)
        self.index += self._frame is not None
        return self._frame is not None

    def image(self) -> NDArray[np.uint8] | None:
        """Convert the frame that was decoded last to (H, W, 3) uint8 RGB, upright; None if that fails."""
        if self._frame is None:
            return None
        if self.form is None:
            self.form = _Form.of(self._frame)
        try:
            return np.ascontiguousarray(self.form.turn.image(self._rgb(self._frame, self.form)))
        except self._errors:
            return None

    def close(self) -> None:
        self._frame, self._frames = None, iter(())
        self._container.close()

    def _rgb(self, frame: av.VideoFrame, form: _Form) -> NDArray[np.uint8]:
        from av.video.reformatter import Colorspace

        if form.transfer is None:
            # Conversion to BGR with this filter gives the same bits as OpenCV's reader. Direct RGB does not always.
            shown = self._reformatter.reformat(frame, form.width, form.height, "bgr24", interpolation="BICUBIC")
            return np.asarray(shown.to_ndarray(), dtype=np.uint8)[..., ::-1]
        matrix = Colorspace[MATRICES.get(frame.colorspace, "BT2020")]
        deep = self._reformatter.reformat(frame, form.width, form.height, "rgb48le", matrix, matrix, "BICUBIC")
        if self._tones is None:
            self._tones = ToneMapping(form.transfer)
        return self._tones(np.asarray(deep.to_ndarray(), dtype=np.uint16))

    def _decoded(self) -> Iterator[av.VideoFrame]:
        """Yield the frames. Packets that cannot be decoded are skipped, as `ffmpeg` does."""
        packets: Iterator[av.Packet | None] = self._container.demux(self._stream)
        while True:
            try:
                packet = next(packets)
            except StopIteration:
                return
            except self._errors as error:
                self.notes.append(f"is cut off or damaged, and mapped up to there ({str(error)[:80]})")
                packets = iter([None])  # flushes the decoder
                continue
            try:
                yield from self._stream.decode(packet)
            except self._errors:
                continue
