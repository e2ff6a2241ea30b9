"""Conversion of a decoded video frame, also an HDR or interlaced one, to an upright picture in 8-bit RGB."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import av
import av.error
import av.filter
import numpy as np
from av.video.reformatter import Colorspace, VideoReformatter
from numpy.typing import NDArray

from modp_ti.inputs.sources.orientation import AS_STORED, Turn
from modp_ti.inputs.sources.tone_mapping import ToneMapping, Transfer

__all__ = ["DECODING_ERRORS", "PictureMaker", "VideoForm"]

# Exceptions that PyAV raises for malformed files.
DECODING_ERRORS = (av.error.FFmpegError, OSError, ValueError, ArithmeticError, MemoryError)
# Largest difference from a quarter turn that a display matrix may have [degrees].
STRAIGHT = 1.0
# By the number in H.273; HDR with another matrix, or with none, is taken to have that of BT.2020.
MATRICES = {1: Colorspace.ITU709, 5: Colorspace.ITU601, 6: Colorspace.ITU601}


@dataclass(frozen=True)
class VideoForm:
    """What all frames of a video have in common; the first frame tells.

    Attributes:
        width: Stored width [px]. Frames of another size are scaled to it.
        height: Stored height [px], likewise.
        turn: How frames are turned upright.
        slant: Rotation that the file asks for beyond `turn` [degrees clockwise], which is not done.
        transfer: Transfer function of HDR video; None for ordinary video.
    """

    width: int
    height: int
    turn: Turn = AS_STORED
    slant: int = 0
    transfer: Transfer | None = None

    @classmethod
    def of(cls, frame: av.VideoFrame) -> VideoForm:
        """Return the form that a frame tells."""
        turn, slant = _turn(frame)
        transfer = next((each for each in Transfer if each.value == frame.color_trc), None)
        return cls(frame.width, frame.height, turn, slant, transfer)


class PictureMaker:
    """Converts the frames of a video."""

    def __init__(self) -> None:
        self._reformatter = VideoReformatter()  # reused, because a new one computes its tables again
        self._tones: ToneMapping | None = None

    def picture(self, frame: av.VideoFrame, form: VideoForm) -> NDArray[np.uint8] | None:
        """Convert a frame to (H, W, 3) uint8 RGB, upright; None if that fails.

        Of an interlaced frame, the upper field is used, and the lines between are interpolated: a moving camera sees
        the lower field from another place.
        """
        try:
            if frame.interlaced_frame:
                image = with_lines_between(self._rgb(_upper_field(frame), form, (form.height + 1) // 2), form.height)
            else:
                image = self._rgb(frame, form, form.height)
        except DECODING_ERRORS:
            return None
        return np.ascontiguousarray(form.turn.image(image))

    def _rgb(self, frame: av.VideoFrame, form: VideoForm, height: int) -> NDArray[np.uint8]:
        if form.transfer is None:
            # Conversion to BGR with this filter gives the same bits as OpenCV's reader. Direct RGB does not always.
            shown = self._reformatter.reformat(frame, form.width, height, "bgr24", interpolation="BICUBIC")
            return np.asarray(shown.to_ndarray(), dtype=np.uint8)[..., ::-1]
        matrix = MATRICES.get(frame.colorspace, Colorspace.BT2020)
        deep = self._reformatter.reformat(frame, form.width, height, "rgb48le", matrix, matrix, "BICUBIC")
        if self._tones is None:
            self._tones = ToneMapping(form.transfer)
        return self._tones(np.asarray(deep.to_ndarray(), dtype=np.uint16))


def with_lines_between(field: NDArray[np.uint8], height: int) -> NDArray[np.uint8]:
    """Return a picture (height, W, 3) whose even lines are those of the field, the odd ones interpolated (cubic)."""
    rows = np.pad(field, ((1, 2), (0, 0), (0, 0)), mode="edge").astype(np.int32)
    between = (9 * (rows[1:-2] + rows[2:-1]) - rows[:-3] - rows[3:] + 8) >> 4
    image = np.empty((2 * len(field), *field.shape[1:]), np.uint8)
    image[0::2] = field
    image[1::2] = np.clip(between, 0, 255)
    return image[:height]


def _upper_field(frame: av.VideoFrame) -> av.VideoFrame:
    """Return the even lines of a frame."""
    graph = av.filter.Graph()
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base)
    graph.link_nodes(source, graph.add("field", "top"), graph.add("buffersink")).configure()
    graph.vpush(frame)
    return graph.vpull()


def _turn(frame: av.VideoFrame) -> tuple[Turn, int]:
    """Return how the display matrix turns a frame, and the rest of its rotation [degrees clockwise]."""
    try:
        # The stubs lack this key.
        matrix = frame.side_data["DISPLAYMATRIX"]  # pyright: ignore[reportGeneralTypeIssues]
        a, b, _, c, d, *_ = struct.unpack("=9i", bytes(matrix))
    except (KeyError, ValueError, struct.error):  # ValueError: the frame has other data, unknown to PyAV
        a, b, c, d = 1, 0, 0, 1
    mirrored = a * d - b * c < 0
    if a == b == 0:
        return AS_STORED, 0
    degrees = math.degrees(math.atan2(-b, -a) if mirrored else math.atan2(b, a))
    quarters = round(degrees / 90)
    slant = degrees - 90 * quarters
    return Turn(quarters % 4, mirrored), round(slant) if abs(slant) > STRAIGHT else 0
