"""Decoding of a video file with PyAV (FFmpeg): frames with their index and time stamp, and seeking."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
from av.stream import Disposition
from numpy.typing import NDArray

from modp_ti.inputs.sources.image_bounds import MAX_IMAGE_PIXELS
from modp_ti.inputs.sources.video_picture import DECODING_ERRORS, PictureMaker, VideoForm

__all__ = ["VideoDecoder"]

# FFmpeg's names of the accepted formats: video containers, but not playlists, which refer to other files.
CONTAINERS = (
    "mov,matroska,webm,avi,mpeg,mpegts,mpegvideo,h264,hevc,vvc,m4v,mjpeg,asf,flv,ogg,"
    "ivf,obu,av1,dv,gxf,mxf,nut,rm,wtv,yuv4mpegpipe,gif,apng,dhav"
)
LIMITS = {"max_pixels": str(MAX_IMAGE_PIXELS)}


class VideoDecoder:
    """Decodes a video stream of a file, frame by frame: as FFmpeg does, a default one before others, then the largest.

    Args:
        path: The video file.
        in_threads: Decode in several threads. This is faster, but damaged parts look different each time.
        form: Size, turn and colours that all frames have; the first frame's if None.

    Attributes:
        index: Index of the frame that was decoded last, -1 before the first.
        form: As the argument; if None, it is set when the first image is converted.
        choice: Which stream is decoded, in words; empty if there is only one. Thumbnails do not count.

    Raises:
        OSError: FFmpeg does not recognise the file as a video.
    """

    def __init__(self, path: Path, in_threads: bool, form: VideoForm | None = None) -> None:
        options = {"format_whitelist": CONTAINERS, "protocol_whitelist": "file", **LIMITS}
        try:
            self._container = av.open(f"file:{path}", options=options, metadata_errors="replace")
        except DECODING_ERRORS:
            raise OSError(str(path)) from None
        # A stream without a context is of a codec unknown to FFmpeg.
        streams = [
            stream
            for stream in self._container.streams.video
            if stream.codec_context is not None and not stream.disposition & Disposition.attached_pic
        ]
        if not streams:
            self._container.close()
            raise OSError(str(path))
        by_rank = lambda each: (bool(each.disposition & Disposition.default), each.width * each.height)  # noqa: E731
        self._stream = max(streams, key=by_rank)
        sizes = ", ".join(f"{each.width}x{each.height}" for each in streams)
        number = streams.index(self._stream) + 1
        self.choice = f"holds {len(streams)} video streams ({sizes}): number {number} is used" if streams[1:] else ""
        self._stream.codec_context.options = LIMITS
        if in_threads:
            self._stream.thread_type = "AUTO"
        else:
            self._stream.codec_context.thread_count = 1
        self._unit = float(self._stream.time_base or 0)  # [s]
        self._start = self._stream.start_time or 0
        self._pictures = PictureMaker()
        self._frame: av.VideoFrame | None = None
        self._frames = self._decoded()
        self.form = form
        self.index = -1

    @property
    def shown(self) -> float:
        """Time stamp of the current frame [ms] from the start of the stream; 0 if the container has none."""
        if self._frame is None or self._frame.pts is None:
            return 0.0
        return (self._frame.pts - self._start) * self._unit * 1000.0

    @property
    def interlaced(self) -> bool:
        """Whether the current frame is interlaced."""
        return self._frame is not None and self._frame.interlaced_frame

    def advance(self) -> bool:
        """Decode the next frame. Returns False at the end."""
        self._frame = next(self._frames, None)
        self.index += self._frame is not None
        return self._frame is not None

    def advance_to(self, index: int) -> bool:
        while self.index < index:
            if not self.advance():
                return False
        return self.index == index

    def seek(self, milliseconds: float) -> float | None:
        """Seek to about this time [ms] and decode a frame. `index` is invalid afterwards.

        Returns:
            Time stamp of the frame [ms], or None at the end or if seeking fails.
        """
        try:
            self._container.seek(self._start + round(milliseconds / 1000.0 / self._unit), stream=self._stream)
        except (*DECODING_ERRORS, AssertionError):  # AssertionError: the container is closed
            return None
        self._frames = self._decoded()
        return self.shown if self.advance() else None

    def image(self) -> NDArray[np.uint8] | None:
        """Convert the frame that was decoded last to (H, W, 3) uint8 RGB, upright; None if that fails."""
        if self._frame is None:
            return None
        if self.form is None:
            self.form = VideoForm.of(self._frame)
        return self._pictures.picture(self._frame, self.form)

    def close(self) -> None:
        self._frame, self._frames = None, iter(())
        self._container.close()

    def _decoded(self) -> Iterator[av.VideoFrame]:
        """Yield the remaining frames. Packets that cannot be decoded are skipped, as `ffmpeg` does."""
        for packet in self._packets():
            try:
                yield from self._stream.decode(packet)
            except DECODING_ERRORS:
                continue

    def _packets(self) -> Iterator[av.Packet | None]:
        """Yield the remaining packets. After a read error, None flushes the decoder."""
        try:
            yield from self._container.demux(self._stream)
        except DECODING_ERRORS:
            yield None
