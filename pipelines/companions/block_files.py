"""`BlockFiles`: Gaussians, and images and points of keyframes, in files."""

from __future__ import annotations

import math
import mmap
import sys
import tempfile
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from fields.runtime.process import give_back_pages, has_room


class BlockError(ValueError):
    """Raised if a file of a block is missing or damaged. The message has one line."""


@dataclass(frozen=True, slots=True)
class StoredBlock:
    """Where a block is stored.

    Attributes:
        path: The file, an array of records in NumPy's .npy format (see `records_of`). Blocks that go to disk together
            share one.
        first: Place of the block's first record in it [bytes].
        count: Number of Gaussians.
        checksum: CRC-32 of the records.
    """

    path: Path
    first: int
    count: int
    checksum: int


def records_of(state: dict[str, NDArray]) -> NDArray[np.void]:
    """Return records (N,) with a field for each entry of `GaussianField.to_numpy` and `history`, in order."""
    fields = [(name, array.dtype, array.shape[1:]) for name, array in state.items()]
    records = np.zeros(len(state["opacity_logit"]), dtype=fields)
    for name, array in state.items():
        records[name] = array
    return records


def state_of(records: NDArray[np.void]) -> dict[str, NDArray]:
    """Return the state of records, for `GaussianField.extend`."""
    return {name: records[name] for name in records.dtype.names or ()}


class BlockFiles:
    """The files of blocks and of keyframes, in a folder of their own that is removed with this object.

    Args:
        folder: Where it is made, with the first file; None for where the system keeps temporary files.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._wanted = folder
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._written = 0
        self._keyframes: list[NDArray] = []  # an array of each file
        self._kind = np.dtype(np.void)  # of the records
        self._used: dict[Path, int] = {}  # number of blocks that each file still holds

    @property
    def path(self) -> Path:
        """The folder, which is created at the first call. Raises OSError if it cannot be."""
        if self._folder is None:
            if self._wanted is not None:
                self._wanted.mkdir(parents=True, exist_ok=True)
            self._folder = tempfile.TemporaryDirectory(
                prefix="modp-ti-blocks-", dir=self._wanted, ignore_cleanup_errors=True
            )
        return Path(self._folder.name)

    def write(self, blocks: Sequence[NDArray[np.void]]) -> list[StoredBlock]:
        """Write the records of blocks to one file. Raises OSError if there is no room, or too little would be left."""
        together = np.concatenate(blocks)
        path = self._next("blocks", ".npy", together.nbytes)
        with _whole(path):
            np.save(path, together, allow_pickle=False)
        self._used[path] = len(blocks)
        self._kind, first = together.dtype, path.stat().st_size - together.nbytes
        stored = []
        for records in blocks:
            stored.append(StoredBlock(path, first, len(records), _checksum(records)))
            first += records.nbytes
        return stored

    def contents(self, path: Path) -> NDArray[np.uint8]:
        """Return the bytes of a file, memory-mapped. Raises BlockError if it is missing."""
        try:
            return np.memmap(path, dtype=np.uint8, mode="r")
        except (OSError, ValueError) as error:
            raise BlockError(f"{path}: blocks of the map are gone ({error})") from None

    def take(self, contents: NDArray[np.uint8], kind: np.dtype, blocks: int) -> Path:
        """Write a file of such contents, and return its path. Raises OSError as `write`.

        Args:
            contents: Result of `contents`.
            kind: Type of the records.
            blocks: Number of blocks in it that are in use.
        """
        path = self._next("blocks", ".npy", contents.nbytes)
        contents.tofile(path)
        self._kind, self._used[path] = kind, blocks
        return path

    def read(self, block: StoredBlock) -> NDArray[np.void]:
        """Return a copy of the records (N,) of a block.

        Raises:
            BlockError: If the file is missing, or the records differ from those that were written.
        """
        try:
            # Not memory-mapped: of every file that a map touches, the system maps much more than the block.
            records = np.fromfile(block.path, self._kind, block.count, offset=block.first)
        except OSError as error:
            raise BlockError(f"{block.path}: blocks of the map are gone ({error.strerror})") from None
        if len(records) != block.count or _checksum(records) != block.checksum:
            raise BlockError(f"{block.path}: a block of the map is damaged ({block.count:,} Gaussians)")
        return records

    def forget(self, block: StoredBlock) -> None:
        """Remove a block, and its file with the last block in it."""
        self._used[block.path] -= 1
        if self._used[block.path] == 0:
            del self._used[block.path]
            block.path.unlink(missing_ok=True)

    def store(self, arrays: Sequence[NDArray]) -> list[NDArray]:
        """Write arrays of keyframes to one file, and return them memory-mapped. Raises OSError as `write` does."""
        path = self._next("keyframes", ".raw", sum(array.nbytes for array in arrays))
        with _whole(path), path.open("w+b") as file:
            for array in arrays:
                file.write(np.ascontiguousarray(array).data)
            file.flush()
            stored = _mapped(file, [(array.dtype, array.shape) for array in arrays])
        self._keyframes.append(stored[0])
        return stored

    def joined(self, count: int, parts: Iterable[Mapping[str, NDArray]]) -> dict[str, NDArray]:
        """Join arrays of `count` rows that come in parts in a file, and return them memory-mapped.

        The file goes with the arrays; on Windows, with the folder. Raises OSError as `write` does.
        """
        following = iter(parts)
        first = next(following)
        kinds = {name: (array.dtype, (count, *array.shape[1:])) for name, array in first.items()}
        sizes = [dtype.itemsize * math.prod(shape) for dtype, shape in kinds.values()]
        path = self._next("map", ".raw", sum(sizes))
        with _whole(path), path.open("w+b") as file:
            ends = np.cumsum([0, *sizes])[:-1].tolist()
            for part in chain([first], following):
                for place, name in enumerate(kinds):
                    file.seek(ends[place])
                    ends[place] += file.write(np.ascontiguousarray(part[name]).data)
            file.flush()
            arrays = _mapped(file, list(kinds.values()))
        with suppress(OSError):  # Windows keeps a file that is mapped
            path.unlink()
        return dict(zip(kinds, arrays, strict=True))

    def forget_pages(self) -> None:
        """Give back the memory of keyframes that have been read. It is taken again when they are read again."""
        give_back_pages(*self._keyframes)

    def _next(self, kind: str, suffix: str, size: int) -> Path:
        """Return the path of a new file of so many bytes."""
        folder = self.path
        if not has_room(folder, size):
            raise OSError(28, "No space left on device")
        self._written += 1
        return folder / f"{kind}-{self._written:06d}{suffix}"


@contextmanager
def _whole(path: Path) -> Iterator[None]:
    """Remove a file that could not be written."""
    try:
        yield
    except Exception:
        path.unlink(missing_ok=True)
        raise


def _mapped(file: IO[bytes], kinds: Sequence[tuple[np.dtype, tuple[int, ...]]]) -> list[NDArray]:
    """Map a file of arrays, given by type and shape, one after the other.

    The mapping is copy-on-write, because kernels take no read-only arrays. Before Python 3.13, it keeps a file open.
    """
    closed = {"trackfd": False} if sys.version_info >= (3, 13) else {}
    mapped, first, arrays = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY, **closed), 0, []
    for dtype, shape in kinds:
        size = math.prod(shape)
        arrays.append(np.frombuffer(mapped, dtype, size, first).reshape(shape))
        first += size * dtype.itemsize
    return arrays


def _checksum(records: NDArray[np.void]) -> int:
    return zlib.crc32(np.ascontiguousarray(records).view(np.uint8).data)
