"""Users, passwords and queries of URLs are nowhere but where the user typed them."""

from __future__ import annotations

import io
import json
import random
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import typer
import yaml
from typer.testing import CliRunner

from modp_ti.commands.app import app
from modp_ti.commands.shared import outcome
from modp_ti.config.scene_file import dump_scene, load_scene, scene_from_data
from modp_ti.files.errors import InputError, actual_url, shown_url, without_secrets
from modp_ti.inputs.source_settings import WITH_SECRETS
from modp_ti.many.batch import with_resources
from modp_ti.many.pool import Resources
from modp_ti.outputs.report.facts import changed_settings
from tests.modp_ti.inputs.mjpeg_camera import MjpegCamera, encoded

if TYPE_CHECKING:
    from tests.room import Room

# Parts of secrets, which nothing that is shown may hold.
WORDS = ["Qx7z", "Wv5k", "Jp3y"]


def hold(text: str) -> bool:
    return any(word in text for word in WORDS)


def test_whatever_a_password_or_a_query_holds_it_is_not_shown():
    rng = random.Random(7)
    between = lambda: "".join(rng.choices("@/#?:&=!%~,;()", k=rng.randint(0, 4)))  # noqa: E731
    for _ in range(3000):
        place = rng.choice(["cam.lan", "10.0.0.7:8554", "[::1]:80"]) + rng.choice(["", "/a/b"])
        secret = f"{between()}{WORDS[0]}{between()}:{WORDS[1]}{between()}"
        urls = f"rtsp://{secret}@{place}", f"http://{place}?pwd={secret}", f"http://{secret}@{place}?key={WORDS[2]}"
        for url in urls:
            for text in (
                shown_url(url),
                without_secrets(f"note: {url}: no stream, see '{url}'."),
                str(InputError(url)),
            ):
                assert not hold(text), (url, text)
        assert shown_url(urls[0]) in (f"rtsp://{place}", "rtsp://...")


@pytest.mark.parametrize(
    "url", ["rtsp://cam:8554/live/a", "http://[::1]:8080/x.mjpg", "s3://bucket/maps", "file:///tmp/a@b", "/dev/video0"]
)
def test_what_is_no_secret_is_shown(url: str):
    assert shown_url(url) == url
    assert without_secrets(f"{url}: it's gone, ask me@example.org?") == f"{url}: it's gone, ask me@example.org?"


SCENE = {"tracker": {"kind": "klt"}, "output": "out"}
SECRET = f"http://{WORDS[0]}:{WORDS[1]}/@127.0.0.1:1/c.mjpg?pwd={WORDS[2]}"


def test_settings_are_written_without_secrets_and_do_not_differ_by_them(tmp_path: Path):
    def scene(url: str):
        return scene_from_data({**SCENE, "source": {"stream": url}, "snapshot_store": url}, "scene")

    config, other = scene(SECRET), scene(SECRET.replace(WORDS[1], "another"))
    assert config.model_dump(mode="json") == other.model_dump(mode="json")
    dump_scene(config, tmp_path / "config.yaml")
    text = (tmp_path / "config.yaml").read_text()
    assert not hold(text) and "# source.stream" in text and "# snapshot_store" in text
    again = load_scene(tmp_path / "config.yaml")
    assert again.model_dump(mode="json") == config.model_dump(mode="json")
    assert not hold(str(changed_settings(config)))
    # The processes of a run get them.
    passed = with_resources(config, Resources()).model_dump(mode="json", context=WITH_SECRETS)
    assert scene_from_data(json.loads(json.dumps(passed)), "scene").source.stream == SECRET


def test_a_url_from_elsewhere_stays_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "url.txt").write_text(f"{SECRET}\n")
    monkeypatch.setenv("CAMERA", SECRET)
    for place in ("from-env:CAMERA", "from-file:url.txt"):
        data = {**SCENE, "source": {"stream": place}}
        (tmp_path / "scene.yaml").write_text(yaml.safe_dump(data))
        config = load_scene(tmp_path / "scene.yaml")
        assert isinstance(config.source.stream, str) and actual_url(config.source.stream) == SECRET
        dump_scene(config, tmp_path / "config.yaml")
        text = (tmp_path / "config.yaml").read_text()
        assert place.partition(":")[0] in text and not hold(text) and "# source.stream" not in text
    for nowhere in ("from-env:NO_SUCH_CAMERA", "from-file:/no/such/file"):
        with pytest.raises(InputError, match=nowhere):
            actual_url(nowhere)


@pytest.mark.parametrize(
    "call",
    [
        ["run", SECRET],
        ["run", "--stream", SECRET],
        ["batch", SECRET.partition("?")[0], SECRET.partition("?")[0] + "/", "-o", "batch"],
        ["check", SECRET],
        ["run", "scene.yaml", "--set", f"source.scale={SECRET}"],
        ["run", "scene.yaml", "--set", f"snapshot_store={SECRET.replace('http', 'nosuch')}"],
    ],
)
def test_no_message_holds_a_secret(call: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    Path("scene.yaml").write_text("source: {}\ntracker: {kind: klt}\noutput: out\n")
    result = CliRunner().invoke(app, call)
    assert result.exit_code in (1, 2) and result.output
    assert not hold(result.output)
    for path in tmp_path.rglob("*"):
        assert not hold(str(path)) and not (path.is_file() and hold(path.read_text())), path


def test_a_fault_of_the_program_does_not_tell_a_secret(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(typer.Exit), outcome(as_json=True):
        raise RuntimeError(f"{SECRET} is odd")
    said, answer = capsys.readouterr()[::-1]
    assert "Traceback" in said and json.loads(answer)["error"]
    assert not hold(said) and not hold(answer)


def contents(data: bytes) -> bytes:
    """The bytes of a file, and of the members of an archive."""
    if not zipfile.is_zipfile(io.BytesIO(data)):
        return data
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return b"".join(contents(archive.read(name)) for name in archive.namelist())


@pytest.mark.slow
def test_a_live_run_leaves_no_secret_behind(room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from tests.room import RoomRecording, pinhole, walk

    monkeypatch.chdir(tmp_path)
    recording = RoomRecording(room, pinhole(160, 120), walk(24))
    camera = MjpegCamera()
    try:
        camera.send_jpeg(*(encoded(image[..., ::-1]) for image in recording.images))
        camera.end()
        url = camera.url.replace("user:secret@", f"{WORDS[0]}:{WORDS[1]}@") + f"&pwd={WORDS[2]}"
        call = ["run", "--stream", url, "--set", "output=out", "--set", "refine.steps=0", "--set", "device=cpu"]
        result = CliRunner().invoke(app, [*call, "--set", "export.session=true"])
    finally:
        camera.shut_down()
    assert result.exit_code == 0, result.output
    assert not hold(result.output)
    files = [file for file in tmp_path.rglob("*") if file.is_file()]
    assert {"config.yaml", "report.html", "session.zip", "metrics.json"} <= {file.name for file in files}
    for file in files:
        assert not hold(contents(file.read_bytes()).decode("latin-1")), file
