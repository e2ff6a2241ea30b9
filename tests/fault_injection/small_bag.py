"""Bags of the small recording: grey images, their camera, odometry, transforms and points."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from tests.bags import OPTICAL, Messages, write_bag
from tests.fault_injection.small_recording import FOCAL, FRAMES, HEIGHT, WIDTH, picture, position, wall

BAGS = {"ros1": "room.bag", "sqlite3": "room.db3", "mcap": "room.mcap"}
"""Name of the bag's file, by its form."""

Change = Callable[[str, Any], Any]


def write_small_bag(
    file: Path, form: str, change: Change = lambda _, message: message, packed: str = "", depths: bool = False
) -> None:
    """Write the bag, in place of the one there.

    Args:
        file: The bag.
        form: Its form.
        change: Returns the new content for the topic and content of each message; None to leave it out.
        packed: How it is packed, "" for not at all.
        depths: Whether it has depth images instead of points.
    """
    make = Messages(form)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    messages: list[tuple[str, int, Any]] = [
        ("/tf_static", 1, make.tree(make.transform(0, "base", "optical", OPTICAL))),
    ]
    if not depths:
        messages.append(("/map", 2, make.cloud(1, wall().astype("<f4"))))
    for i in range(FRAMES):
        time = i * 10**8 + 10**9
        T = np.eye(4)
        T[0, 3] = position(i)
        messages.append(("/odom", time, make.odometry(time, T @ np.linalg.inv(OPTICAL))))
        messages.append(("/image", time, make.image(time, picture(i)[..., 1], "mono8")))
        messages.append(("/camera_info", time, make.info(time, K, (WIDTH, HEIGHT))))
        if depths:
            messages.append(("/depth", time, make.image(time, np.full((HEIGHT, WIDTH), 3000, "<u2"), "16UC1")))
    changed = [(topic, time, new) for topic, time, old in messages if (new := change(topic, old)) is not None]
    with TemporaryDirectory() as folder:
        written = write_bag(Path(folder) / "bag", form, changed, packed, defined=False)
        content = written if form == "ros1" else next(each for each in written.iterdir() if each.suffix == file.suffix)
        file.write_bytes(content.read_bytes())
