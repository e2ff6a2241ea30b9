"""`Tenancy`: which objects have fields in the engine's program, and the lock under which they use them."""

from __future__ import annotations

import functools
import gc
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from fields.runtime.backend import (
    MAX_SPARSE,
    initialise,
    on_gpu,
    program,
    restart,
    running_backend,
    sparse_nodes,
    too_many,
)
from fields.runtime.engine import engine, forget_unfinished, lock, running_program

T = TypeVar("T")

# Sparse SNodes after which the engine is started again as soon as nobody has fields: their memory is not given back
# before. Where the engine has a limit, it is that.
CROWDED = 16 if MAX_SPARSE is None else MAX_SPARSE


class Tenancy:
    """The fields of an object and of the parts it is made of, as long as the engine's program that has them runs.

    As a context manager, it lets one thread at a time use them.

    Args:
        kept: Whether they count as in use as long as the tenancy exists. Otherwise they may go to make room.

    Raises:
        RuntimeError: On entry, if the fields are gone: `initialise` was called since, or `close`.
    """

    def __init__(self, kept: bool) -> None:
        self._program: object | None = program()
        self.kept = kept

    @property
    def is_open(self) -> bool:
        """Whether the fields are still there."""
        return self._program is not None and self._program is running_program()

    def close(self) -> None:
        """Give up the fields. Their memory is used again once the engine has to start again to make room."""
        with lock:
            self._program = None

    def __enter__(self) -> None:
        lock.acquire()
        if not self.is_open:
            why = "closed" if self._program is None else f"freed when {engine().title} was started again"
            lock.release()
            raise RuntimeError(f"this object was {why}: make a new one")

    def __exit__(self, *_: object) -> None:
        lock.release()


class Tenant:
    """An object with fields that its user may close, also by using it as a context manager.

    Attributes:
        tenancy: Its fields.
    """

    tenancy: Tenancy

    def close(self) -> None:
        """Give up the fields, so that others have room. Every method that needs them raises RuntimeError from then on.

        The memory is used again by the next map that finds no room next to what is not closed.
        """
        self.tenancy.close()

    def __enter__(self: T) -> T:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_tenancies: weakref.WeakSet[Tenancy] = weakref.WeakSet()
_settling: Tenancy | None = None


@contextmanager
def settled(nodes: int, kept: bool = True) -> Iterator[Tenancy]:
    """Make the fields of an object. The parts that are made meanwhile share its tenancy.

    Args:
        nodes: Number of sparse SNodes that the object and its parts need on the CPU.
        kept: Whether they stay as long as the tenancy exists, see `Tenancy`.

    Raises:
        RuntimeError: If the engine does not run, or has no room for them. All others stay as they are.
    """
    global _settling
    with lock:
        if _settling is not None:
            yield _settling
            return
        program()
        if not on_gpu() and sparse_nodes() + nodes > CROWDED:
            if _is_empty():
                restart()
            elif MAX_SPARSE is not None:
                raise too_many()
        _settling = tenancy = Tenancy(kept)
        try:
            yield tenancy
        except BaseException:
            forget_unfinished()
            raise
        finally:
            _settling = None
        _tenancies.add(tenancy)


def in_engine(*methods: str) -> Callable[[type[T]], type[T]]:
    """Let methods of a class run only while the fields of its `tenancy` are there, one thread at a time."""

    def guarded(method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def call(self: Any, *arguments: Any, **named: Any) -> Any:
            with self.tenancy:
                return method(self, *arguments, **named)

        return call

    def with_guards(cls: type[T]) -> type[T]:
        for name in methods:
            setattr(cls, name, guarded(vars(cls)[name]))
        return cls

    return with_guards


def empty() -> None:
    """Start the engine again, which frees all fields, unless some are in use.

    Raises:
        RuntimeError: If some are in use.
    """
    with lock:
        if not _is_empty():
            raise too_many()
        restart()


def _is_empty() -> bool:
    gc.collect()  # what is only part of a cycle is not used any more
    return not any(tenancy.kept and tenancy.is_open for tenancy in _tenancies)


def ensure_started(device: str) -> str:
    """Start the engine on a device as `initialise` does, unless others use it, and return the backend in use.

    Raises:
        RuntimeError: If a GPU was requested and does not start, or the engine is in use on another device.
    """
    with lock:
        backend = running_backend()
        if backend is None or _is_empty():
            return initialise(device)
        if device not in ("auto", backend):
            raise RuntimeError(f"device: {device} was asked for, but maps or renderers are in use on {backend}")
        return backend
