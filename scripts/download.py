"""Download sequences of TUM RGB-D and Replica, resume interrupted downloads, verify and unpack them.

The publishers provide no checksums. The SHA-256 of the first download is written to `checksums.txt` next to the
archives, and later downloads must match it. This detects files that changed, but not one that was wrong from the start.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import stat
import tarfile
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from ending import documented_ending

TUM = "https://cvg.cit.tum.de/rgbd/dataset"
REPLICA = "https://cvg-data.inf.ethz.ch/nice-slam/data/Replica.zip"
REPLICA_SCENES = ("office0", "office1", "office2", "office3", "office4", "room0", "room1", "room2")

CHECKSUMS = "checksums.txt"
CHUNK = 1 << 20
TIMEOUT = 60.0  # seconds without receiving data
# Maximum ratio of unpacked size to archive size. Images hardly compress.
MOST_GROWTH = 50


class DownloadError(Exception):
    """A download failed. The message has one line."""


@dataclass(frozen=True)
class Sequence:
    """A sequence inside an archive.

    Attributes:
        url: Where to download the archive.
        folder: The sequence's folder inside the archive.
        licence: The publishers' licence.
    """

    url: str
    folder: str
    licence: str

    @property
    def archive(self) -> str:
        return self.url.rpartition("/")[2]


def _tum(camera: int, name: str) -> Sequence:
    folder = f"rgbd_dataset_freiburg{camera}_{name}"
    return Sequence(f"{TUM}/freiburg{camera}/{folder}.tgz", folder, "CC BY 4.0")


SEQUENCES: dict[str, Sequence] = {
    "fr1/desk": _tum(1, "desk"),
    "fr2/xyz": _tum(2, "xyz"),
    "fr3/office": _tum(3, "long_office_household"),
    # All scenes share one archive of about 12 GB, which is downloaded once.
    **{
        f"replica/{s}": Sequence(REPLICA, f"Replica/{s}", "Replica's research licence, rendered by NICE-SLAM")
        for s in REPLICA_SCENES
    },
}


def download(url: str, target: Path, say: Callable[[int, int | None], None] | None = None) -> None:
    """Download `url` to `target`, resuming from `target`.partial if an earlier attempt left it.

    Args:
        url: The file's URL.
        target: Where to store it.
        say: Called with the bytes so far and the total, None if the server does not announce it.

    Raises:
        DownloadError: If the server refuses, or the size differs from the announced one.
    """
    if target.exists():
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    partial, mark = target.with_name(target.name + ".partial"), target.with_name(target.name + ".etag")
    done = partial.stat().st_size if partial.exists() else 0
    # The server must only send the rest if the file is unchanged, which it checks with this validator.
    validator = mark.read_text() if done and mark.exists() else None
    headers = {"Range": f"bytes={done}-", "If-Range": validator} if validator else {}
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=TIMEOUT) as answer:
            resumed = answer.status == 206
            done = done if resumed else 0
            announced = answer.headers.get("Content-Length")
            total = None if announced is None else done + int(announced)
            if not resumed:
                mark.write_text(answer.headers.get("ETag") or answer.headers.get("Last-Modified") or "")
            room = shutil.disk_usage(target.parent).free
            if total is not None and total - done > room:
                raise DownloadError(f"{target.parent}: {total - done:,} bytes are to come, {room:,} are free")
            with partial.open("ab" if resumed else "wb") as file:
                while chunk := answer.read(CHUNK):
                    file.write(chunk)
                    done += len(chunk)
                    if say is not None:
                        say(done, total)
    except urllib.error.HTTPError as error:
        if error.code == 416:  # the partial file is longer than the server's
            partial.unlink()
            mark.unlink(missing_ok=True)
        raise DownloadError(f"{url}: the server says {error.code} {error.reason}; run again") from None
    except OSError as error:  # URLError, time-out, reset
        raise DownloadError(
            f"{url}: {getattr(error, 'reason', error)}; run again to go on from {done:,} bytes"
        ) from None
    if total is not None and done != total:
        raise DownloadError(f"{url}: cut off at {done:,} of {total:,} bytes; run again to go on")
    os.replace(partial, target)
    mark.unlink(missing_ok=True)


def sha256(file: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    with file.open("rb") as data:
        digest = hashlib.sha256()
        while chunk := data.read(CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


def verify(archive: Path) -> bool:
    """Compare an archive with `checksums.txt` next to it. An unknown archive's checksum is added to the file.

    Returns:
        Whether the archive was known.

    Raises:
        DownloadError: If the checksum differs.
    """
    listing = archive.with_name(CHECKSUMS)
    known = {}
    if listing.exists():
        known = dict(reversed(line.split(maxsplit=1)) for line in listing.read_text().splitlines() if line.strip())
    found = sha256(archive)
    if archive.name not in known:
        with listing.open("a") as file:
            file.write(f"{found}  {archive.name}\n")
        return False
    if known[archive.name] != found:
        raise DownloadError(
            f"{archive}: its SHA-256 is {found}, {listing} has {known[archive.name]}: delete the archive to fetch it "
            "again, or that line if the publisher has changed it"
        )
    return True


def unpack(archive: Path, folder: str, target: Path) -> int:
    """Unpack the content of `folder` in a .tgz or .zip archive to `target`, which appears whole or not at all.

    Returns:
        Number of files.

    Raises:
        DownloadError: If the archive is damaged, has a member outside its folder, a link or a device, or exceeds
            MOST_GROWTH times its size. Nothing is kept then.
    """
    staging = target.with_name(target.name + ".partial")
    shutil.rmtree(staging, ignore_errors=True)
    staging.mkdir(parents=True)
    left = MOST_GROWTH * archive.stat().st_size
    count = 0
    try:
        for name, size, open_member in _members(archive):
            inside = _inside(name, folder, archive)
            if inside is None:
                continue
            left -= size
            if left < 0:
                raise DownloadError(f"{archive}: unpacks to more than {MOST_GROWTH} times its size: not unpacked")
            file = staging / inside
            file.parent.mkdir(parents=True, exist_ok=True)
            with open_member() as source, file.open("xb") as copy:
                shutil.copyfileobj(source, copy, CHUNK)
            count += 1
        if count == 0:
            raise DownloadError(f"{archive}: holds no {folder}")
        os.replace(staging, target)
    except (tarfile.TarError, zipfile.BadZipFile, EOFError, OSError) as error:
        raise DownloadError(f"{archive}: cannot be unpacked: {error}; delete it to fetch it again") from None
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return count


def _members(archive: Path) -> Iterator[tuple[str, int, Callable[[], IO[bytes]]]]:
    """Yield name, size and content of every file. Raises DownloadError for links and devices."""
    if archive.suffix == ".zip":
        with zipfile.ZipFile(archive) as bundle:
            for entry in bundle.infolist():
                if stat.S_ISLNK(entry.external_attr >> 16):
                    raise DownloadError(f"{archive}: holds a link ({entry.filename}): not unpacked")
                if not entry.is_dir():
                    yield entry.filename, entry.file_size, lambda entry=entry: bundle.open(entry)
        return
    with tarfile.open(archive, "r|gz") as bundle:  # sequential reading, without seeking
        for entry in bundle:
            if entry.isdir():
                continue
            if not entry.isfile():
                raise DownloadError(f"{archive}: holds a link or a device ({entry.name}): not unpacked")
            yield entry.name, entry.size, lambda entry=entry: bundle.extractfile(entry)


def _inside(name: str, folder: str, archive: Path) -> PurePosixPath | None:
    """Return a member's path below `folder`, or None if it is outside. Raises DownloadError for unsafe names."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or ":" in path.parts[0]:
        raise DownloadError(f"{archive}: holds a file that leads out of its folder ({name}): not unpacked")
    try:
        return path.relative_to(folder)
    except ValueError:
        return None


def fetch(name: str, folder: Path, say: Callable[[str], None], sequences: dict[str, Sequence] = SEQUENCES) -> Path:
    """Download, verify and unpack a sequence below `folder`, and return its path. Finished steps are skipped."""
    sequence = sequences[name]
    target = folder / name
    if target.exists():
        say(f"{name}: is there: {target}")
        return target
    archive = folder / "archives" / sequence.archive
    last = -1

    def progress(done: int, total: int | None) -> None:
        nonlocal last
        step = done // (64 << 20)
        if step != last:
            last = step
            say(f"{sequence.archive}: {done >> 20} MiB" + ("" if total is None else f" of {total >> 20}"))

    download(sequence.url, archive, progress)
    unknown = f"its SHA-256 is not known here; kept in {archive.with_name(CHECKSUMS)} for next time"
    say(f"{sequence.archive}: {'SHA-256 as at the first download' if verify(archive) else unknown}")
    target.parent.mkdir(parents=True, exist_ok=True)
    count = unpack(archive, sequence.folder, target)
    say(f"{name}: {count} files in {target} (licence: {sequence.licence})")
    return target


@documented_ending(DownloadError)
def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: scripts/download fr1/desk -o data",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(SEQUENCES))
    parser.add_argument("-o", "--output", type=Path, default=Path("data"), help="folder of the sequences (data)")
    arguments = parser.parse_args()
    if not arguments.names:
        for name, sequence in SEQUENCES.items():
            print(f"{name:16} {sequence.url}")
        return
    unknown = [name for name in arguments.names if name not in SEQUENCES]
    if unknown:
        parser.error(f"{unknown[0]}: no such sequence; there are {', '.join(SEQUENCES)}")
    for name in arguments.names:
        fetch(name, arguments.output, lambda line: print(line, flush=True))


if __name__ == "__main__":
    main()
