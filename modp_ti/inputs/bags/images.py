"""Source `bag`: the images of a topic of a ROS bag."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from modp_ti.files.errors import InputError, UnreadableImageError
from modp_ti.inputs.bags.bag import IMAGES, INFO, Bag, Place
from modp_ti.inputs.bags.messages import (
    begins_video,
    camera_of_info,
    info_beside,
    is_compressed,
    is_deep,
    is_depth,
    is_grey,
    is_rectified,
    picture,
    picture_size,
    stored_values,
    video_codec,
)
from modp_ti.inputs.bags.transforms import clean, seconds
from modp_ti.inputs.source_settings import BagImagesSettings
from modp_ti.inputs.sources.image_pixels import DEPTHS, used_bits
from modp_ti.inputs.sources.protocol import ImageSource
from modp_ti.inputs.sources.undistortion import Intrinsics
from modp_ti.inputs.sources.video_file import VideoFile

SAMPLED = 16  # images of 16 bits per channel by which their depth is found


class _Image(NamedTuple):
    """An image in the bag: its time [s], and where it is."""

    time: float
    place: Place


class BagImages(ImageSource):
    """An `ImageSource` of a topic of images, raw or compressed. Image n, from 0, is called `<bag>_<n, six digits>`.

    All messages of the topic are read once when the bag is opened, for their times and sizes. Times are those in the
    headers; if all of them are zero, those of the recording.

    Args:
        path: The bag.
        settings: The topics.
        stop: Number of images to use; all if None.
        calibrated: Whether the camera is taken from the bag.

    Attributes:
        bag: The bag.
        topic: The topic of the images.
        frame_id: Name of the camera's frame, as the images state it.

    Raises:
        InputError: If the bag is damaged, or has no image.
    """

    def __init__(
        self, path: Path, settings: BagImagesSettings, stop: int | None = None, calibrated: bool = True
    ) -> None:
        self.bag = Bag(path)
        self._video: VideoFile | None = None
        try:
            self.topic, others = _chosen_topic(self.bag, settings.image)
            first = self.bag.first(self.topic)
            self.frame_id = clean(first.header.frame_id)
            codec = video_codec(first)
            found, size, left_out = self._listed(stop) if codec is None else self._video_listed(codec, stop)
            found.sort(key=lambda image: image.time)
            images = [image for n, image in enumerate(found) if n == 0 or image.time > found[n - 1].time]
            names = [f"{path.stem}_{n:06d}" for n in range(len(images))]
            super().__init__(path, names, [image.time for image in images])
            self._size = size
            self._place = {name: image.place for name, image in zip(names, images, strict=True)}
            stated = first.format if is_compressed(first) else first.encoding
            choice = f"; there are also {', '.join(others)} (source.bag.image)" if others else ""
            self.add_note(f"{path}: images of {self.topic} ({stated}){choice}")
            if left_out:
                self.add_note(f"{left_out} images of {self.topic} have another size than the first: left out")
            if len(images) < len(found):
                self.add_note(f"{len(found) - len(images)} images of {self.topic} have the time of another: left out")
            self._bits = DEPTHS[-1]
            if is_deep(first):
                self._bits, deep = used_bits(map(self._deep_values, names[:: max(1, len(names) // SAMPLED)]), path)
                self._notes += deep
            if calibrated:
                self.intrinsics = self._camera(settings.camera_info)
        except InputError:
            self.bag.close()
            raise

    def read(self, name: str) -> NDArray[np.uint8]:
        """Decode an image (H, W, 3) uint8 RGB.

        Raises:
            UnreadableImageError: If it is damaged.
        """
        if self._video is not None:
            return self._video.read(self._frame_of[self._place[name]])
        message = self.bag.read(self.topic, self._place[name])
        try:
            image = picture(message, self._bits)
        except ValueError as error:
            raise UnreadableImageError(f"{self.path}: unreadable image {name} of {self.topic}: {error}") from None
        if image.shape[1::-1] != self._size:
            raise UnreadableImageError(f"{self.path}: image {name} of {self.topic} is of another size than it states")
        return image

    def close(self) -> None:
        self.bag.close()
        if self._video is not None:
            self._video.close()

    def _deep_values(self, name: str) -> NDArray:
        message = self.bag.read(self.topic, self._place[name])
        try:
            return stored_values(message, "u2", 3 if message.encoding.startswith(("rgb", "bgr")) else 1)
        except ValueError:  # told when the image is read
            return np.zeros(1, np.uint16)

    def _listed(self, stop: int | None) -> tuple[list[_Image], tuple[int, int], int]:
        """Return the images of the first one's size, that size, and how many are of another size."""
        images: list[_Image] = []
        size, left_out, stamped = None, 0, False
        for place, message in self.bag.messages(self.topic):
            if stop is not None and len(images) >= stop:
                break
            its = picture_size(message)
            size = size or its
            if its != size:
                left_out += 1
                continue
            time = seconds(message.header.stamp)
            stamped |= time != 0.0
            images.append(_Image(time, place))
        if size is None:
            raise InputError(f"{self.bag.path}: no image of {self.topic} states its size; it is damaged")
        if not stamped:
            images = [_Image(image.place.written * 1e-9, image.place) for image in images]
        return images, size, left_out

    def _video_listed(self, codec: str, stop: int | None) -> tuple[list[_Image], tuple[int, int], int]:
        """Return the same of messages that hold the pictures of a video, which is unpacked to a temporary file."""
        self._folder = TemporaryDirectory(prefix="modp-ti-")
        file = Path(self._folder.name) / f"{self.bag.path.stem}.{codec}"
        images: list[_Image] = []
        with file.open("wb") as stream:
            for place, message in self.bag.messages(self.topic):
                if images or begins_video(message):
                    stream.write(message.data.tobytes())
                    images.append(_Image(seconds(message.header.stamp) or place.written * 1e-9, place))
        if not images:
            raise InputError(f"{self.bag.path}: the video of {self.topic} ({codec}) has no start, so none is decoded")
        self._video = VideoFile(file, stop=stop)
        images, names = images[:stop], self._video.names
        if len(names) != len(images):
            raise InputError(
                f"{self.bag.path}: {len(images)} messages of {self.topic} hold {len(names)} pictures of a video "
                f"({codec}), which must be as many: convert it to a video file, and map that"
            )
        self._frame_of = {image.place: name for image, name in zip(images, names, strict=True)}
        return images, self._video.frame_size, 0

    def _camera(self, given: str | None) -> Intrinsics | None:
        """Return the camera of the images, with notes on where it comes from; None if the bag does not tell it."""
        topics = self.bag.of_types(INFO)
        if given is not None:
            topic = self.bag.chosen(given, (INFO,), "source.bag.camera_info")
        else:
            topic = info_beside(self.topic, topics)
        if topic is None:
            there = f"; there is {', '.join(topics)} (source.bag.camera_info)" if topics else ""
            self.add_note(f"{self.path}: no CameraInfo belongs to {self.topic}{there}")
            return None
        rectified = is_rectified(self.topic)
        camera = camera_of_info(self.bag.first(topic), rectified, f"{self.path}: {topic}")
        of = "the rectified camera P" if rectified else "the camera K with its lens"
        self.add_note(f"{self.path}: {f'{topic} is not calibrated' if camera is None else f'{of} of {topic}'}")
        return camera


def _chosen_topic(bag: Bag, given: str | None) -> tuple[str, list[str]]:
    """Return the topic of the images, the given one or else the first in colour, and the other ones."""
    if given is not None:
        return bag.chosen(given, IMAGES, "source.bag.image"), []
    firsts = {topic: bag.first(topic) for topic in bag.of_types(*IMAGES)}
    pictures = [topic for topic, first in firsts.items() if not is_depth(first)]
    if not pictures:
        there = ", ".join(f"{topic} ({kind})" for topic, kind in list(bag.topics.items())[:8])
        raise InputError(f"{bag.path}: holds no images; its topics are {there or 'none'} (source.path)")
    pictures.sort(key=lambda topic: (is_grey(firsts[topic]), topic))
    return pictures[0], pictures[1:]
