"""Tracker `socket`: another program tracks and sends its frames, poses, points and corrections through a socket."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from queue import Empty, Full, Queue
from socket import SHUT_WR, create_connection
from threading import Event as Flag
from threading import Thread
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from fields.frames.pose_correction import PoseCorrection
from fields.frames.tracked_frame import SparsePoints, TrackedFrame
from modp_ti.files.errors import InputError
from modp_ti.inputs.protocol import Event, LiveCounts, Progress, Tracker
from modp_ti.inputs.replay import PosedImage, pictures_again, points_inside, tracked_frame
from modp_ti.inputs.sources import Picture
from modp_ti.inputs.tracker_server.listening import (
    GLANCE,
    Connection,
    Lobby,
    SenderGoneError,
    listen,
    open_to_others,
)
from modp_ti.inputs.tracker_server.messages import (
    Correction,
    Frame,
    Hello,
    Kind,
    ProtocolError,
    UnfitError,
    parse_correction,
    parse_frame,
    parse_hello,
)
from modp_ti.inputs.tracker_server.ordering import Ordering
from modp_ti.inputs.tracker_server.spool import Spool, SpoolFullError, is_stream

if TYPE_CHECKING:
    from modp_ti.inputs.readers.socket import SocketSettings
    from modp_ti.inputs.source_settings import SourceSettings

# What the server has received, in order; None at its end. Images and points of frames are in the spool.
_Waiting = Frame | PoseCorrection | InputError | None

# Pause [s] after a connection that failed before its first frame: BREATH times the number of such connections, at most
# LONGEST_BREATH. Without it, a client that reconnects in a loop would keep a processor busy.
BREATH, LONGEST_BREATH = 0.01, 0.5
# Frames and corrections that wait for the mapper before the server reads no more. They wait on disk.
MAX_WAITING = 1000
# Unusable messages that are skipped before the stream ends: FEW_UNFIT, plus UNFIT_SHARE of the frames received.
FEW_UNFIT, UNFIT_SHARE = 3, 0.1


class TrackerServer(Tracker):
    """A live `Tracker` that listens on a socket and delivers what another program sends.

    A background thread reads and checks the messages, and stores them on disk. Whoever iterates decodes their images.
    When `MAX_WAITING` frames and corrections wait for it, the server stops reading, and the sender's writes block.

    A connection that fails before its first frame is dropped and counted in a note; the server keeps listening. Idle
    connections do not block an active sender. After the first frame, the end of the connection ends the stream, and the
    run continues with the frames received so far. Received data are kept in a temporary folder until `close`.

    Args:
        source: Settings of the images: scale, masks, held-out frames, queue length. `path`, `start`, `stop` and `step`
            must not be set.
        tracker: Address or path of the socket, and timeout.
        progress: Called when the server starts to wait for a tracker, and when the wait is over.

    Attributes:
        address: Where the server listens, as `host:port` or `unix:path`.

    Raises:
        InputError: If the server cannot listen at this address, or if settings select files or frames.
    """

    reads_ahead: ClassVar[bool] = True
    corrects: ClassVar[bool] = True

    def __init__(self, source: SourceSettings, tracker: SocketSettings, progress: Progress | None = None) -> None:
        if source.start or source.stop is not None or source.step != 1:
            raise InputError(
                "tracker.kind: socket takes every frame that is sent: take source.start, stop and step out"
            )
        if source.path is not None:
            raise InputError("tracker.kind: socket gets its images through the socket: take source.path out")
        self._source = source
        self._patience = tracker.patience
        self._again = tracker.path if is_stream(tracker.path) else None
        self._path = None if self._again else tracker.path
        self._listener, self.address = listen("127.0.0.1:0" if self._again else tracker.address, self._path)
        self._notes = [f"frames come from {self._again or self.address}"]
        if open_to_others(self._listener):
            self._notes.append(f"{self.address} is open to the network: whoever reaches it can send frames")
        self._progress = progress
        self._spool: Spool | None = None
        self._taken = 0  # frames
        self._indices: dict[int, int] = {}  # indices of the delivered frames by the sender's frame numbers
        self._dropped, self._dropped_note = 0, ""
        self._unfit: list[str] = []  # error messages of the skipped messages
        self._waiting: Queue[_Waiting] = Queue(MAX_WAITING)
        self._newest = 0.0  # arrival of the newest frame
        self._arrived = self._lost = 0
        self._closed = Flag()
        self._ended = False
        self._say_waiting(0)
        # Daemon threads, so that the process can exit without `close`.
        self._thread = Thread(target=self._serve, name="server", daemon=True)
        self._thread.start()
        if self._again is not None:
            Thread(target=self._send_again, args=(self._again, self._listener.getsockname()), daemon=True).start()

    # ---- called by the mapper, in its thread -----------------------------------------------------------------

    @property
    def notes(self) -> list[str]:
        return self._notes

    @property
    def scale(self) -> float:
        """Factor on the sent images' sides. `source.scale: auto` keeps them, since their sender chooses their size."""
        return 1.0 if self._source.scale == "auto" else self._source.scale

    @property
    def kept(self) -> Mapping[str, Mapping[str, str | None]]:
        again = self._spool is None or self._again is not None
        return {} if again else {"tracker": {"address": None, "path": str(self._received.stream)}}

    @property
    def live(self) -> LiveCounts:
        tracked = len(self._indices)
        return LiveCounts(self._arrived, tracked, 0, self._lost, max(0, tracked - self._taken), self._newest)

    def __iter__(self) -> Iterator[Event]:
        """Iterate once over frames and corrections as they arrive.

        Raises:
            InputError: If the run's settings do not fit the received frames, or the server fails.
        """
        while not self._ended and not self._closed.is_set():
            try:
                item = self._waiting.get(timeout=GLANCE)
            except Empty:
                continue
            self._say_waiting(1)
            if item is None or isinstance(item, InputError):
                self._ended = True
                if item is not None:
                    raise item
                return
            if isinstance(item, PoseCorrection):
                yield item
                continue
            frame = self._decoded(item)
            self._taken += 1
            yield frame

    def pictures(self, names: Sequence[str]) -> Iterator[tuple[str, Picture]]:
        return pictures_again(self._received.reader, ((name, self._received.undistorter) for name in names))

    def close(self) -> None:
        """Stop listening, disconnect the sender and delete the temporary files."""
        self._closed.set()
        self._thread.join()
        if self._spool is not None:
            self._spool.close()

    @property
    def _received(self) -> Spool:
        """The received frames. A HELLO must have arrived."""
        assert self._spool is not None
        return self._spool

    def _decoded(self, frame: Frame) -> TrackedFrame:
        """Read the image and the points of a frame that has its pose."""
        spool, pose = self._received, frame.T_camera_world
        assert pose is not None
        try:
            points = spool.points(frame.place)
            pixels = spool.undistorter.points(points.pixels)
            points = points_inside(points.xyz, pixels, points.ids, spool.undistorter, pose)
            posed = PosedImage(spool.name(frame.number), spool.undistorter, pose, points)
            return tracked_frame(spool.reader, self._taken, posed)
        except Exception as error:
            raise InputError(f"{self.address}: a stored frame cannot be read again: {error}") from None

    def _say_waiting(self, done: int) -> None:
        if self._progress is not None:
            self._progress(f"waiting for a tracker at {self.address}", done, 1)
            self._progress = self._progress if done == 0 else None

    # ---- the server's thread -----------------------------------------------------------------------------------

    def _serve(self) -> None:
        end: InputError | None = None
        lobby = Lobby(self._listener, self._patience)
        try:
            while not self._closed.is_set():
                sock = lobby.next(GLANCE)
                if lobby.dropped:
                    self._count_dropped("it said nothing", lobby.dropped)
                    lobby.dropped = 0
                if sock is None:
                    continue
                if self._talk(Connection(sock, self._patience, self._closed)) or self._again:
                    break
        except InputError as error:
            end = error
        except Exception as error:  # a bug in this thread must end the run instead of leaving it waiting
            end = InputError(f"{self.address}: the server failed: {type(error).__name__}: {error}")
        finally:
            lobby.close()
            self._listener.close()
            if self._path is not None:
                self._path.unlink(missing_ok=True)
            self._put(end)

    def _talk(self, connection: Connection) -> bool:
        """Serve one connection until it ends. Returns whether the stream has ended with it."""
        ordering = Ordering()
        hello: Hello | None = None
        problem = None
        try:
            while True:
                kind, payload = connection.receive(hello)
                if kind is Kind.HELLO:
                    hello = parse_hello(payload)
                    if self._spool is not None:
                        self._spool.close()  # left by a connection that sent no frame
                    self._spool = Spool(hello, self._source)
                    connection.say(Kind.WELCOME)
                place = self._received.keep(kind, payload)
                if kind is Kind.END:
                    break
                if kind is not Kind.HELLO:
                    try:
                        self._take(kind, payload, place, ordering)
                    except UnfitError as error:
                        self._leave_out(error, ordering)
                    self._deliver(ordering)
        except (SenderGoneError, ProtocolError) as error:
            problem = str(error)
            connection.refuse(problem)
        except SpoolFullError as error:
            connection.refuse(f"the run takes no more: {error}")
            if not ordering.begun:
                raise InputError(str(error)) from None
            problem = str(error)
        except InputError as error:
            connection.refuse(f"the run stops: {error}")
            raise
        if problem is not None and not ordering.begun:
            self._count_dropped(problem, 1)
            self._closed.wait(min(BREATH * self._dropped, LONGEST_BREATH))
            return False
        if problem is not None:
            self._notes.append(f"the stream ended early: {problem}; the run went on with the frames before")
        ordering.close()
        self._deliver(ordering)
        if self._unfit:
            messages = "1 message was" if len(self._unfit) == 1 else f"{len(self._unfit)} messages were"
            self._notes.append(f"{messages} left out: {'' if len(self._unfit) == 1 else 'the last: '}{self._unfit[-1]}")
        if ordering.lost:
            self._notes.append(f"{ordering.lost} of {len(self._spool or ())} frames came without a pose: skipped")
        if problem is None:
            connection.say(Kind.DONE, struct.pack("<I", len(self._indices)))
            connection.close()
        return True

    def _leave_out(self, error: UnfitError, ordering: Ordering) -> None:
        """Skip an unusable message. Raises ProtocolError before the first frame, and if there are too many."""
        self._unfit.append(str(error))
        if not ordering.begun or len(self._unfit) > FEW_UNFIT + UNFIT_SHARE * len(self._spool or ()):
            self._unfit.pop()
            raise ProtocolError(str(error))
        if error.number is not None:
            ordering.leave_out(error.number)

    def _count_dropped(self, problem: str, count: int) -> None:
        """Update the single note about connections that failed before their first frame."""
        self._dropped += count
        many = "a connection" if self._dropped == 1 else f"{self._dropped} connections"
        were = "was" if self._dropped == 1 else "were"
        last = "" if self._dropped == 1 else "the last: "
        note = f"{many} to {self.address} {were} dropped before the first frame: {last}{problem}"
        self._notes = [*(other for other in self._notes if other != self._dropped_note), note]
        self._dropped_note = note

    def _take(self, kind: Kind, payload: bytes, place: int, ordering: Ordering) -> None:
        """Process one FRAME, POSE or CORRECTION message.

        Raises ProtocolError if it is malformed or out of place, and UnfitError if it is well-formed but unusable.
        """
        if kind is Kind.CORRECTION:
            ordering.add_correction(parse_correction(payload))
            return
        frame = parse_frame(payload, kind, place)
        if kind is Kind.POSE:
            ordering.add_pose(frame)
            return
        spool = self._received
        ordering.require_next(frame)
        name = spool.add(frame)
        spool.reader.require_fitting([(name, spool.undistorter)])
        ordering.add_frame(frame)
        self._arrived, self._newest = self._arrived + 1, spool.arrived(name)
        if len(spool) == 1 and spool.hello.name:
            self._notes.append(f"the tracker there is {spool.hello.name}")

    def _deliver(self, ordering: Ordering) -> None:
        """Queue what is ready for the mapper; block while the queue is full."""
        for item in ordering.ready():
            self._lost = ordering.lost
            if self._closed.is_set():
                return
            if isinstance(item, Correction):
                index = np.array([self._indices[number] for number in item.numbers.tolist()], dtype=np.int64)
                self._put(PoseCorrection(index, item.T_camera_world, item.ids, item.xyz))
            else:
                self._indices[item.number] = len(self._indices)
                self._put(replace(item, points=SparsePoints()))
        self._lost = ordering.lost

    def _put(self, item: _Waiting) -> None:
        while not self._closed.is_set():
            try:
                self._waiting.put(item, timeout=GLANCE)
            except Full:
                continue
            return

    @staticmethod
    def _send_again(file: Path, address: tuple[str, int]) -> None:
        """Send a stream that a killed run has kept, as far as it goes."""
        with suppress(OSError), file.open("rb") as stream, create_connection(address) as connection:
            connection.sendfile(stream)
            connection.shutdown(SHUT_WR)
            while connection.recv(1024):  # until the server has read everything
                pass
