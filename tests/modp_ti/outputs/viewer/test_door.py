"""Who comes in at the viewer's port, and what a browser can do to the rest: nothing."""

from __future__ import annotations

import http.client
import io
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec
import numpy as np
import pytest
import viser
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection, connect
from zstandard import ZstdDecompressor

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.outputs.measuring import Ruler, SurfacePoint
from modp_ti.outputs.viewer.handover import Gate
from modp_ti.outputs.viewer.modes import Splats
from modp_ti.outputs.viewer.page import Page
from tests.patience import PATIENCE

CAMERA = PinholeCamera(100.0, 100.0, 60.0, 40.0, 120, 80)
PROTOCOL = f"viser-v{viser.__version__}"


class Tips(Ruler):
    """A surface where rays of length one end, and none behind."""

    def point(self, origin: np.ndarray, ray: np.ndarray, pixel: float) -> SurfacePoint | None:
        return SurfacePoint(origin + ray, np.zeros((3, 3))) if ray[2] > 0 else None


@pytest.fixture
def gate() -> Gate:
    return Gate()


@pytest.fixture
def page(gate: Gate) -> Iterator[Page]:
    page = Page("127.0.0.1", 0, gate, choose=lambda client, frame: None, frames=5, ruler=Tips({}))
    yield page
    page.close()


def get(url: str, **headers: str) -> tuple[int, bytes]:
    """Status and body of a request with just these headers."""
    parts = urlsplit(url)
    connection = http.client.HTTPConnection("127.0.0.1", parts.port, timeout=PATIENCE)
    connection.putrequest("GET", parts.path or "/", skip_host=True, skip_accept_encoding=True)
    for name, value in ({"Host": f"127.0.0.1:{parts.port}"} | headers).items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, answer.read()


def opened(url: str, **options: Any) -> ClientConnection:
    given = {
        "subprotocols": [PROTOCOL],
        "max_size": None,
        "compression": None,
        "open_timeout": PATIENCE,
        "close_timeout": 0.5,
    }
    given |= options
    return connect(url.replace("http", "ws"), **given)


def message(kind: str, **fields: Any) -> bytes:
    return msgspec.msgpack.encode({"type": kind, **fields})


def camera(**changed: Any) -> bytes:
    place = {"wxyz": [1.0, 0, 0, 0], "position": [0.0, 0, 0], "look_at": [0.0, 0, 1], "up_direction": [0.0, -1, 0]}
    lens = {"fov": 1.0, "near": 0.01, "far": 100.0, "image_height": 480, "image_width": 640}
    return message("ViewerCameraMessage", **(place | lens | changed))


def put(uuid: str, value: Any) -> bytes:
    return message("GuiUpdateMessage", uuid=uuid, updates={"value": value})


def click(**changed: Any) -> bytes:
    where = {"ray_origin": [0.0, 0, 0], "ray_direction": [0.0, 0, 1], "screen_pos": [[0.5, 0.5]]}
    return message("ScenePointerMessage", **({"event_type": "click", "modifier": None} | where | changed))


def heard(browser: ClientConnection, until: Callable[[dict], bool]) -> dict:
    """The first message for which `until` holds."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        raw = browser.recv(timeout=PATIENCE)
        size, packed = (int.from_bytes(raw[at : at + 8], "little") for at in (0, 8))
        unpacked = ZstdDecompressor().decompress(raw[16 : 16 + packed], max_output_size=size)
        for found in msgspec.msgpack.decode(unpacked)["messages"]:
            if until(found):
                return found
    raise TimeoutError


def entered(page: Page) -> tuple[ClientConnection, dict[str, str]]:
    """A browser that has said where it looks from, and its controls by label."""
    browser, controls = opened(page.url), {}
    browser.send(camera())

    def last(found: dict) -> bool:
        if "uuid" in found and "label" in found.get("props", {}):
            controls[found["props"]["label"]] = found["uuid"]
        return "Link to this view" in controls

    heard(browser, last)
    end = time.monotonic() + PATIENCE
    while not len(page.requests):
        assert time.monotonic() < end
        time.sleep(0.01)
    return browser, controls


def is_alive(page: Page) -> bool:
    browser, _ = entered(page)
    browser.close()
    return get(page.url)[0] == 200


def test_a_viser_that_does_not_ask_the_door_is_not_served(monkeypatch: pytest.MonkeyPatch):
    class Another:
        def __init__(self, **given: Any) -> None:
            self.stop = lambda: None

    monkeypatch.setattr(viser, "ViserServer", Another)
    with pytest.raises(InputError, match="viser"):
        Page("127.0.0.1", 0)


def test_without_the_whole_address_nothing_is_read(page: Page):
    parts = urlsplit(page.url)
    start, token = f"http://127.0.0.1:{parts.port}", parts.path.rstrip("/")
    assert get(page.url)[0] == 200
    for asked in ("", "/", "/index.html", "/x/", f"{token}x/", f"/..{token}/", f"/{token}"):
        status, body = get(start + asked)
        assert status == 403 and b"<html" not in body and token.encode() not in body
        with pytest.raises(InvalidHandshake):
            opened(start + asked)


def test_pages_of_other_origins_read_nothing_even_with_the_address(page: Page):
    host = urlsplit(page.url).netloc
    for origin in ("http://evil.example", "null", "http://127.0.0.1:1", f"https://{host}", f"http://{host}.evil"):
        assert get(page.url, Origin=origin)[0] == 403
        with pytest.raises(InvalidHandshake):
            opened(page.url, origin=origin)
    opened(page.url, origin=f"http://{host}").close()


def test_only_the_served_address_is_a_host(page: Page):
    port = urlsplit(page.url).port
    for host in (f"evil.example:{port}", "evil.example", "127.0.0.1", "127.0.0.1:1", f"10.0.0.1:{port}", ""):
        assert get(page.url, Host=host)[0] == 403
    assert get(page.url, Host=f"LOCALHOST:{port}")[0] == 200


def test_two_pages_have_two_secrets(page: Page):
    other = Page("127.0.0.1", 0)
    try:
        assert get(f"{urlsplit(other.url)._replace(path=urlsplit(page.url).path).geturl()}")[0] == 403
    finally:
        other.close()


HOSTILE: dict[str, Callable[[dict[str, str]], bytes | str]] = {
    "text": lambda c: "hello",
    "nothing": lambda c: b"",
    "noise": lambda c: bytes(range(256)) * 8,
    "no map": lambda c: msgspec.msgpack.encode([1, 2]),
    "no type": lambda c: msgspec.msgpack.encode({"uuid": "x"}),
    "type of no kind": lambda c: message([1]),
    "unknown type": lambda c: message("Nonsense", a=1),
    "deep": lambda c: b"\x91" * 8000 + b"\xc0",
    "large": lambda c: camera(padding="x" * 100_000),
    "huge": lambda c: bytes(60 << 20),
    "share": lambda c: message("ShareUrlRequest"),
    "unshare": lambda c: message("ShareUrlDisconnect"),
    "slider": lambda c: put(c["Frame"], -(10**6)),
    "slider, text": lambda c: put(c["Frame"], "1"),
    "slider, not finite": lambda c: put(c["Frame"], float("nan")),
    "mode": lambda c: put(c["Show"], "nonsense"),
    "mode, list": lambda c: put(c["Show"], ["splats"]),
    "box": lambda c: put(c["Keyframes"], "yes"),
    "another property": lambda c: message("GuiUpdateMessage", uuid=c["Show"], updates={"update_cb": []}),
    "no such control": lambda c: put("nowhere", 1),
    "short position": lambda c: camera(position=[0.1, 0]),
    "position of text": lambda c: camera(position=["a", 0, 0]),
    "position, not finite": lambda c: camera(position=[float("inf"), 0, 0]),
    "canvas": lambda c: camera(image_width=1 << 40),
    "canvas below nothing": lambda c: camera(image_height=-1),
    "another field": lambda c: camera(owner=3),
    "drawn rectangle": lambda c: click(event_type="rect-select"),
    "click of text": lambda c: click(ray_origin=["a", 0, 0]),
    "click, not finite": lambda c: click(ray_direction=[0.0, 0, float("inf")]),
    "click at nothing": lambda c: click(ray_direction=None),
    "upload": lambda c: message(
        "FileTransferStartUpload",
        source_component_uuid=c["Frame"],
        transfer_uuid="a",
        filename="f",
        mime_type="t",
        part_count=10**9,
        size_bytes=10**12,
    ),
    "part": lambda c: message(
        "FileTransferPart", source_component_uuid=c["Frame"], transfer_uuid="a", part_index=0, content=bytes(15_000)
    ),
    "form": lambda c: message("GuiFormDirtyMessage", uuid="x" * 10_000),
}


def test_a_hostile_message_ends_at_most_its_own_session(page: Page, capfd: pytest.CaptureFixture[str]):
    other, _ = entered(page)
    for kind, hostile in HOSTILE.items():
        browser, controls = entered(page)
        try:
            browser.send(hostile(controls))
            browser.send(camera(position=[0.5, 0, 0]))
            browser.recv(timeout=0.05)
        except (ConnectionClosed, TimeoutError):
            pass
        browser.close()
        assert other.ping().wait(PATIENCE), f"{kind}: the other browser is still connected"
    other.send(camera(position=[0.25, 0, 0]))
    other.close()
    assert is_alive(page)
    assert capfd.readouterr() == ("", "")


def resident() -> int:
    return 4096 * int(Path("/proc/self/statm").read_text().split()[1])


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc")
def test_no_message_and_no_transfer_fills_the_memory(page: Page):
    assert is_alive(page)
    before = resident()
    for kind in HOSTILE:
        browser, controls = entered(page)
        hostile = HOSTILE[kind](controls)
        try:
            for _ in range(3 if len(hostile) > 1 << 20 else 100):
                browser.send(hostile)
        except ConnectionClosed:
            pass
        browser.close()
    assert is_alive(page)
    assert resident() - before < 50e6


def test_a_fault_of_one_browser_ends_its_session_alone(page: Page):
    browser, _ = entered(page)
    first = page.requests.next()
    assert first is not None
    other, _ = entered(page)
    page.attempt(first.client, lambda: [][1])
    with pytest.raises(ConnectionClosed):
        while True:
            browser.recv(timeout=PATIENCE)
    other.ping().wait(PATIENCE)
    other.close()


def test_each_browser_has_its_own_mode_and_frame():
    chosen: list[tuple[int, int]] = []
    page = Page("127.0.0.1", 0, choose=lambda *pair: chosen.append(pair), frames=5)
    try:
        page.settle(2.0, np.eye(4), CAMERA)
        grey = np.zeros((2, 3), np.uint8)
        page.show_splats(Splats(np.zeros((2, 3), np.float32), np.tile(np.eye(3), (2, 1, 1)), grey, grey[:, :1], 2))
        one, controls = entered(page)
        other, _ = entered(page)
        one.send(put(controls["Show"], "depth"))
        one.send(put(controls["Frame"], 3))
        end = time.monotonic() + PATIENCE
        while not (page.requests.shows("depth") and any(frame == 3 for _, frame in chosen)):
            assert time.monotonic() < end
            time.sleep(0.01)
        seen = {}
        while (request := page.requests.next()) is not None:
            seen[request.client] = request.mode
        assert sorted(seen.values()) == ["depth", "splats"]
        (changed,) = [client for client, mode in seen.items() if mode == "depth"]
        assert [client for client, frame in chosen if frame == 3] == [changed]
        # The scale of the depth, of which the other browser hears nothing.
        scale = heard(one, lambda m: "depth" in str(m.get("updates", {}).get("content")))
        assert all(number in scale["updates"]["content"] for number in ("0.5", "2", "8"))
        one.close()
        other.close()
    finally:
        page.close()


def test_a_browser_measures_between_its_clicks(page: Page):
    page.settle(2.0, np.eye(4), CAMERA)
    browser, controls = entered(page)
    browser.send(put(controls["Measure"], True))
    heard(browser, lambda m: "ScenePointer" in m["type"])
    for ray in ([0.0, 0, 1], [0.0, 0, -1], [0.0, 0.75, 1]):  # the second meets nothing
        browser.send(click(ray_direction=ray))
    assert "0.75" in heard(browser, lambda m: m["type"] == "LabelMessage")["props"]["text"]
    browser.send(put(controls["Measure"], False))
    heard(browser, lambda m: m["type"] == "RemoveSceneNodeMessage" and m["name"] == "/measured")
    browser.close()


def test_a_browser_gets_splats_of_its_own_and_the_first_view_is_that_of_the_camera(page: Page):
    T = np.eye(4)
    T[:3, 3] = [1.0, 2.0, 3.0]
    browser, _ = entered(page)
    page.settle(2.0, T, CAMERA)
    request = page.requests.next()
    assert request is not None
    grey = np.zeros((2, 3), dtype=np.uint8)
    splats = Splats(np.zeros((2, 3), np.float32), np.tile(np.eye(3, dtype=np.float32), (2, 1, 1)), grey, grey[:, :1], 5)
    page.show_splats(splats, request.client + 1)  # one that has left meanwhile
    page.show_splats(splats, request.client)
    found: dict[str, Any] = {}

    def complete(told: dict) -> bool:
        found[told["type"]] = told
        return told["type"] == "GaussianSplatsMessage"

    heard(browser, complete)
    browser.close()
    np.testing.assert_allclose(found["SetCameraPositionMessage"]["position"], -T[:3, 3] * page.units)
    assert found["SetCameraFovMessage"]["fov"] == pytest.approx(2 * np.arctan(0.4))


def test_the_browser_that_paused_is_known_until_it_leaves(page: Page, gate: Gate):
    browser, controls = entered(page)
    other, _ = entered(page)
    browser.send(put(controls["Pause"], True))
    end = time.monotonic() + PATIENCE
    while not gate.paused:
        assert time.monotonic() < end
        time.sleep(0.01)
    assert gate.holder in page.requests
    browser.close()
    while gate.holder in page.requests:
        assert time.monotonic() < end
        time.sleep(0.01)
    assert len(page.requests) == 1
    other.close()


def test_the_address_is_printed_even_if_nothing_else_is():
    from rich.console import Console

    from modp_ti.config.settings import ViewSettings
    from modp_ti.engine.stream import open_observer
    from modp_ti.outputs.progress import ProgressLine

    for host, lines in (("127.0.0.1", 1), ("0.0.0.0", 2)):  # and a line that the page is open to other machines
        said = io.StringIO()
        line = ProgressLine(Console(file=said, quiet=True))
        with ExitStack() as held:
            open_observer(ViewSettings(enabled=True, host=host, port=0), line.note, line.insist, held)
            line.note("something else")
            url = said.getvalue().split()[1]
            assert said.getvalue().count("\n") == lines
            assert get(url)[0] == 200
