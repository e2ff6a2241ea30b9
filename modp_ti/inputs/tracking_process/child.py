"""The tracker's process: opens the source and the tracker, tracks, and sends what the tracker delivers."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress
from dataclasses import fields
from multiprocessing.connection import Connection
from queue import Queue

import cv2

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import TrackedFrame
from modp_ti.files.errors import InputError
from modp_ti.files.processes import left_to_parent
from modp_ti.files.terminal import own_terminal
from modp_ti.inputs.klt import KltTracker, open_klt
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.sources import ImageSource, Picture
from modp_ti.inputs.tracking_process.parent import CameraRevised, CountsBoard, Ended, Job, Opened, Preparing

# Interval [s] at which the counts are published and the wish to finish is noticed.
GLANCE = 0.05
# Events that may wait for the mapper before the tracker waits too. A frame without its picture takes some 15 KB.
LIMIT = 2000

# Names of the attributes of a frame without its picture, which the parent reads.
REST = {field.name for field in fields(TrackedFrame)} - {field.name for field in fields(Picture)}


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
    _Child(connection, CountsBoard.of(board), job).run()


class _Child:
    """The tracker and its threads: this one tracks, one sends, and one listens to the parent."""

    def __init__(self, connection: Connection, board: CountsBoard, job: Job) -> None:
        self._connection = connection
        self._board = board
        self._job = job
        self._outbox: Queue[object] = Queue(LIMIT)
        self._images: ImageSource | None = None
        self._tracker: KltTracker | None = None
        self._sender = threading.Thread(target=self._send, name="sender", daemon=True)
        self._sender.start()
        threading.Thread(target=self._listen, name="parent", daemon=True).start()

    def run(self) -> None:
        """Track the source to its end."""
        source = self._job.config.source
        error = failure = None
        try:
            self._images = open_source(source, self._job.folder)
            scene = self._job.config  # its tracker is `klt`, the one that follows streams
            self._tracker = tracker = open_klt(source, scene.tracker, scene.seed, self._prepare, self._images)
            self._publish()
            self._outbox.put(Opened(tracker.notes, tracker.scale, tracker.intrinsics))
            for event in tracker:
                self._publish()
                if isinstance(event, PoseCorrection) and event.camera is not None:
                    self._outbox.put(CameraRevised(tracker.intrinsics))
                is_frame = isinstance(event, TrackedFrame)
                self._outbox.put({name: getattr(event, name) for name in REST} if is_frame else event)
        except InputError as caught:
            error = caught
        except Exception as caught:  # told to the parent, which saves its map
            failure = f"{type(caught).__name__}: {caught}"
        self._publish()
        notes = [] if self._tracker is None else self._tracker.notes
        unreadable = {} if self._tracker is None else dict(self._tracker.unreadable)
        self._outbox.put(Ended(notes, unreadable, error, failure))
        self._sender.join()
        if self._images is not None:
            self._images.close()

    def _prepare(self, what: str, done: int, total: int) -> None:
        self._outbox.put(Preparing(what, done, total))

    def _publish(self) -> None:
        if self._images is not None:
            self._board.recording = self._images.recording
        if self._tracker is not None:
            frames, live = self._tracker.frame_count, self._tracker.live
            self._board.frame_count = -1 if frames is None else frames
            for name in ("arrived", "tracked", "thinned", "lost", "newest") if live is not None else ():
                setattr(self._board, name, getattr(live, name))

    def _send(self) -> None:
        """Send the events in order until the end; runs in a thread, so that the mapper does not hold up the tracker."""
        message = None
        with suppress(BrokenPipeError):  # the parent is gone
            while not isinstance(message, Ended):
                message = self._outbox.get()
                self._connection.send(message)

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
