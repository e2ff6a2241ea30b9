"""The tracker's process: opens the source and the tracker, tracks, and sends what the tracker delivers."""

from __future__ import annotations

import os
import sys
import threading
from collections import deque
from contextlib import suppress
from dataclasses import fields
from multiprocessing.connection import Connection
from typing import Any

import cv2

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.files.errors import InputError
from modp_ti.files.processes import left_to_parent
from modp_ti.files.terminal import own_terminal
from modp_ti.inputs.klt import KltTracker, open_klt
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.sources import FrameReader, ImageSource, Picture, Undistorter
from modp_ti.inputs.tracking_process.parent import (
    CameraRevised,
    CountsBoard,
    Ended,
    Job,
    Opened,
    Preparing,
    Vignette,
    with_vignette,
)

# Interval [s] at which the counts are published and the wish to finish is noticed.
GLANCE = 0.05
# Events that may wait for the mapper. A frame without its image takes some 15 KB.
LIMIT = 2000
# Memory of the images of waiting frames [bytes], for example of 140 frames of 320x240. Reading an image again takes a
# third of the time of tracking it, on the same core: with room for four, a stream of 30 frames a second fell behind.
ROOM = 128 << 20

# Names of the attributes of a frame without its picture, which is read again, and their values by name.
REST = {field.name for field in fields(TrackedFrame)} - {field.name for field in fields(Picture)}
WithoutPicture = dict[str, Any]

_Message = PoseCorrection | CameraRevised | Ended


def main() -> None:
    """Serve the parent process, whose descriptors of pipe and board are the arguments."""
    left_to_parent()
    own_terminal()
    cv2.setNumThreads(1)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the end of a stream is told in a note
    pipe, board = (int(argument) for argument in sys.argv[1:3])
    connection = Connection(pipe)
    try:
        job = connection.recv()
    except EOFError:
        return
    with suppress(BrokenPipeError):  # the parent is gone
        _Child(connection, CountsBoard(board), job).run()


class _Child:
    """The tracker and its threads: this one tracks, one sends, and one listens to the parent."""

    def __init__(self, connection: Connection, board: CountsBoard, job: Job) -> None:
        self._connection = connection
        self._board = board
        self._job = job
        self._outbox = Outbox()
        self._images: ImageSource | None = None
        self._tracker: KltTracker | None = None
        threading.Thread(target=self._listen, name="parent", daemon=True).start()

    def run(self) -> None:
        """Track the source to its end."""
        source = self._job.config.source
        error = failure = None
        sender = None
        try:
            self._images = open_source(source, self._job.folder)
            scene = self._job.config  # its tracker is `klt`, the one that follows streams
            self._tracker = tracker = open_klt(source, scene.tracker, scene.seed, self._prepare, self._images)
            self._publish()
            self._connection.send(Opened(tracker.notes, tracker.scale, tracker.intrinsics))
            sender = threading.Thread(target=self._send, args=(tracker.undistorter,), name="sender", daemon=True)
            sender.start()
            for event in tracker:
                self._publish()
                if isinstance(event, PoseCorrection) and event.camera is not None:
                    self._outbox.put(CameraRevised(tracker.intrinsics))
                self._outbox.put(event)
        except InputError as caught:
            error = caught
        except Exception as caught:  # told to the parent, which saves its map
            failure = f"{type(caught).__name__}: {caught}"
        self._publish()
        notes = [] if self._tracker is None else self._tracker.notes
        ended = Ended(notes, {} if self._tracker is None else dict(self._tracker.unreadable), error, failure)
        if sender is None:
            self._connection.send(ended)
        else:
            self._outbox.put(ended)
            sender.join()
        if self._images is not None:
            self._images.close()

    def _prepare(self, what: str, done: int, total: int) -> None:
        self._connection.send(Preparing(what, done, total))

    def _publish(self) -> None:
        if self._images is not None:
            self._board.recording = self._images.recording
        if self._tracker is not None:
            self._board.write(self._tracker.live, self._tracker.frame_count)

    # ---- the sending thread ----------------------------------------------------------------------------------

    def _send(self, undistorter: Undistorter) -> None:
        """Send the events in order, each frame as soon as the parent takes it.

        Args:
            undistorter: Undistorter of the first frame. The tracker may have a newer one already.
        """
        assert self._tracker is not None and self._images is not None
        reader = FrameReader(self._images, self._job.config.source)
        vignette = None
        while True:
            event = self._outbox.get()
            try:
                if isinstance(event, dict):
                    event = TrackedFrame(**event, **vars(reader.read(event["name"], undistorter)))
                if isinstance(event, TrackedFrame):
                    if event.vignette is not vignette:
                        vignette = event.vignette
                        self._connection.send(Vignette(vignette))
                    _ = event.pyramid  # built here, to save the parent time
                    event = with_vignette(event, None)
                elif isinstance(event, CameraRevised):
                    undistorter = event.intrinsics.undistorter(self._tracker.scale)
                self._connection.send(event)
                if isinstance(event, Ended):
                    return
            except InputError as error:  # a stored image is gone
                self._connection.send(Ended(self._tracker.notes, self._tracker.unreadable, error))
                return

    # ---- the listening thread --------------------------------------------------------------------------------

    def _listen(self) -> None:
        """Publish the counts, and end the recording when asked. Exit when the parent has no more use.

        If the parent was killed, the frames that were recorded stay.
        """
        finished = False
        try:
            while True:
                if self._connection.poll(GLANCE):  # None, or the end
                    self._connection.recv()
                    os._exit(0)
                self._publish()
                if self._board.finish and not finished and self._images is not None:
                    finished = True
                    self._images.finish()
        except (EOFError, OSError):
            if self._job.folder is not None:
                how = f"modp-ti run --resume {self._job.config.output}"
                sys.stderr.write(f"error: the mapper has ended; {how} maps the frames that were recorded\n")
            os._exit(1)


class Outbox:
    """Queue of frames and corrections, in order.

    Waiting frames keep their images while these fit into `room`. The images of the others are read again when it is
    their turn. The tracker is not held up before `LIMIT` events wait.

    Args:
        room: Memory of the images [bytes]. One frame keeps its image in any case.
    """

    def __init__(self, room: int = ROOM) -> None:
        self._room = room
        self._taken = 0
        self._events: deque[TrackedFrame | WithoutPicture | _Message] = deque()
        self._changed = threading.Condition()

    def put(self, event: TrackedFrame | _Message) -> None:
        """Append an event; wait while the queue is full."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._events) < LIMIT)
            if not isinstance(event, TrackedFrame):
                self._events.append(event)
            elif self._taken == 0 or self._taken + event.image.nbytes <= self._room:
                self._taken += event.image.nbytes
                self._events.append(event)
            else:
                self._events.append({name: getattr(event, name) for name in REST})
            self._changed.notify_all()

    def get(self) -> TrackedFrame | WithoutPicture | _Message:
        """Take the first event; wait for it."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._events) > 0)
            event = self._events.popleft()
            if isinstance(event, TrackedFrame):
                self._taken -= event.image.nbytes
            self._changed.notify_all()
            return event
