"""Downloads from a server of this machine: what is cut off goes on, what leads out is refused."""

from __future__ import annotations

import hashlib
import io
import random
import re
import tarfile
import threading
import zipfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import download
import pytest
from download import DownloadError, Sequence


class Server:
    """Files by path, with ETags and ranges; `cut` makes it break off after so many bytes."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.cut: int | None = None
        self.asked: list[str | None] = []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                data = outer.files.get(self.path)
                asked = self.headers.get("Range")
                outer.asked.append(asked)
                if data is None:
                    self.send_error(404)
                    return
                etag = f'"{hashlib.md5(data).hexdigest()}"'
                first = 0
                if asked and self.headers.get("If-Range") == etag:
                    first = int(re.fullmatch(r"bytes=(\d+)-", asked)[1])
                self.send_response(206 if first else 200)
                self.send_header("ETag", etag)
                self.send_header("Content-Length", str(len(data) - first))
                self.end_headers()
                self.wfile.write(data[first:] if outer.cut is None else data[first : first + outer.cut])

            def log_message(self, *arguments: object) -> None:
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_port}"


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    thread = threading.Thread(target=server.http.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    yield server
    server.http.shutdown()
    server.http.server_close()
    thread.join()


def tgz(files: dict[str, bytes | tarfile.TarInfo]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as bundle:
        for name, content in files.items():
            if isinstance(content, tarfile.TarInfo):
                bundle.addfile(content)
                continue
            entry = tarfile.TarInfo(name)
            entry.size = len(content)
            bundle.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


def link(name: str, target: str, kind: bytes = tarfile.SYMTYPE) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(name)
    entry.type, entry.linkname = kind, target
    return entry


PICTURE = random.Random(1).randbytes(100_000)  # which does not shrink


def test_a_sequence_is_fetched_checked_and_unpacked_once(server: Server, tmp_path: Path) -> None:
    data = tgz({"seq/rgb/1.png": PICTURE, "seq/rgb.txt": b"1 rgb/1.png\n", "other/2.png": b"no"})
    server.files["/a/seq.tgz"] = data
    sequences = {"fr9/seq": Sequence(f"{server.url}/a/seq.tgz", "seq", "none")}
    said: list[str] = []
    folder = download.fetch("fr9/seq", tmp_path, said.append, sequences)
    assert folder == tmp_path / "fr9" / "seq"
    assert {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()} == {"rgb/1.png", "rgb.txt"}
    assert (folder / "rgb" / "1.png").read_bytes() == PICTURE
    listing = tmp_path / "archives" / "checksums.txt"
    assert listing.read_text() == f"{hashlib.sha256(data).hexdigest()}  seq.tgz\n"
    assert "is not known here" in said[-2]
    assert sorted(p.name for p in (tmp_path / "archives").iterdir()) == ["checksums.txt", "seq.tgz"]
    download.fetch("fr9/seq", tmp_path, said.append, sequences)
    assert len(server.asked) == 1


def test_a_download_that_was_cut_off_goes_on(server: Server, tmp_path: Path) -> None:
    data = bytes(range(251)) * 4000
    server.files["/f"] = data
    server.cut = 300_000
    with pytest.raises(DownloadError, match="run again to go on"):
        download.download(f"{server.url}/f", tmp_path / "f")
    assert not (tmp_path / "f").exists()
    assert (tmp_path / "f.partial").stat().st_size == 300_000
    server.cut = None
    download.download(f"{server.url}/f", tmp_path / "f")
    assert (tmp_path / "f").read_bytes() == data
    assert server.asked == [None, "bytes=300000-"]
    assert [p.name for p in tmp_path.iterdir()] == ["f"]


def test_a_file_that_changed_on_the_server_is_fetched_from_its_start(server: Server, tmp_path: Path) -> None:
    server.files["/f"] = b"old" * 1000
    server.cut = 500
    with pytest.raises(DownloadError):
        download.download(f"{server.url}/f", tmp_path / "f")
    server.files["/f"] = b"new!" * 1000
    server.cut = None
    download.download(f"{server.url}/f", tmp_path / "f")
    assert (tmp_path / "f").read_bytes() == b"new!" * 1000


def test_a_missing_file_and_a_missing_server_are_said_in_one_line(server: Server, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match="the server says 404"):
        download.download(f"{server.url}/none", tmp_path / "f")
    with pytest.raises(DownloadError, match="run again"):
        download.download("http://127.0.0.1:9/none", tmp_path / "f")
    assert not (tmp_path / "f").exists()


def test_an_archive_that_differs_from_its_first_download_is_found(tmp_path: Path) -> None:
    archive = tmp_path / "a.tgz"
    archive.write_bytes(b"first")
    assert not download.verify(archive)
    assert download.verify(archive)
    archive.write_bytes(b"second")
    with pytest.raises(DownloadError, match="its SHA-256 is"):
        download.verify(archive)


EVIL = {
    "out": tgz({"seq/1.png": b"1", "seq/../../evil": b"2"}),
    "absolute": tgz({"seq/1.png": b"1", "/tmp/evil": b"2"}),
    "link": tgz({"seq/1.png": b"1", "seq/evil": link("seq/evil", "/etc")}),
    "hard link": tgz({"seq/1.png": b"1", "seq/evil": link("seq/evil", "/etc/passwd", tarfile.LNKTYPE)}),
    "device": tgz({"seq/1.png": b"1", "seq/evil": link("seq/evil", "", tarfile.CHRTYPE)}),
    "bomb": tgz({"seq/1.png": bytes(20_000_000)}),
    "cut off": tgz({"seq/1.png": PICTURE})[:-40],
    "elsewhere": tgz({"else/1.png": b"1"}),
    "twice": tgz({"seq/1.png": b"1", "seq/./1.png": b"2"}),
}


@pytest.mark.parametrize("case", EVIL)
def test_an_archive_that_cannot_be_trusted_leaves_nothing(case: str, tmp_path: Path) -> None:
    archive = tmp_path / "seq.tgz"
    archive.write_bytes(EVIL[case])
    with pytest.raises(DownloadError, match=r"seq\.tgz") as caught:
        download.unpack(archive, "seq", tmp_path / "seq")
    assert "\n" not in str(caught.value)
    assert [p.name for p in tmp_path.iterdir()] == ["seq.tgz"]


def test_one_scene_of_a_zip_is_unpacked(tmp_path: Path) -> None:
    archive = tmp_path / "Replica.zip"
    with zipfile.ZipFile(archive, "w") as bundle:
        bundle.writestr("Replica/office0/traj.txt", "1 0 0 0\n")
        bundle.writestr("Replica/office0/results/frame000000.jpg", PICTURE)
        bundle.writestr("Replica/office1/traj.txt", "no\n")
    assert download.unpack(archive, "Replica/office0", tmp_path / "office0") == 2
    assert (tmp_path / "office0" / "results" / "frame000000.jpg").read_bytes() == PICTURE
    with zipfile.ZipFile(archive, "a") as bundle:
        bundle.writestr("Replica/office0/../../../evil", "x")
    with pytest.raises(DownloadError, match="leads out of its folder"):
        download.unpack(archive, "Replica/office0", tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_the_table_names_the_sequences_of_the_paper() -> None:
    assert {"fr1/desk", "fr2/xyz", "fr3/office", "replica/office0", "replica/room2"} <= set(download.SEQUENCES)
    assert len(download.SEQUENCES) == 3 + 8
    for name, sequence in download.SEQUENCES.items():
        assert re.fullmatch(r"https://[a-z.-]+/[\w/.-]+\.(tgz|zip)", sequence.url), name
        assert sequence.archive in sequence.url
    assert download.SEQUENCES["fr1/desk"].archive == "rgbd_dataset_freiburg1_desk.tgz"
