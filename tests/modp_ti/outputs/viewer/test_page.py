"""The page as it is served: to whom, what it says where it cannot be, and to browsers that do not listen."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlparse
from urllib.request import urlopen

import numpy as np
import pytest

from fields.geometry.camera import PinholeCamera
from modp_ti.files.errors import InputError
from modp_ti.outputs.viewer.modes import Splats, frustum_lines
from modp_ti.outputs.viewer.page import DEPTH_ON_PAGE, KEYFRAME_SIZE, Page, ShownFrame
from tests.patience import PATIENCE

CAMERA = PinholeCamera(100.0, 100.0, 60.0, 40.0, 120, 80)


@pytest.fixture
def page() -> Iterator[Page]:
    page = Page("127.0.0.1", 0)
    yield page
    page.close()


def test_the_page_is_served_to_this_machine_alone_unless_asked_for(page: Page, capfd: pytest.CaptureFixture[str]):
    assert b"<html" in urlopen(page.url, timeout=PATIENCE).read()
    port = urlparse(page.url).port
    # Whoever listens at all addresses listens at this one too.
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", port), timeout=PATIENCE)
    to_all = Page("0.0.0.0", port)
    try:
        assert urlparse(to_all.url).port > port, "the next free port"
        socket.create_connection(("127.0.0.2", urlparse(to_all.url).port), timeout=PATIENCE).close()
    finally:
        to_all.close()
    with pytest.raises(InputError, match=r"view\.host"):
        Page("192.0.2.1", 0)
    assert capfd.readouterr() == ("", ""), "viser's own messages"


def test_frustums_have_their_tips_at_the_cameras_and_their_corners_in_the_images_corners():
    rng = np.random.default_rng(1)
    poses = np.tile(np.eye(4), (3, 1, 1))
    for T in poses:
        T[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        T[:3, :3] *= np.linalg.det(T[:3, :3])
        T[:3, 3] = rng.normal(size=3)
    units = 2.5
    lines = frustum_lines(poses, CAMERA, units, KEYFRAME_SIZE).reshape(3, 8, 2, 3)
    for T, edges in zip(poses, lines, strict=True):
        seen = (edges / units) @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(seen[:4, 0], 0.0, atol=1e-6)
        np.testing.assert_allclose(seen[:4, 1, 2] * units, KEYFRAME_SIZE, rtol=1e-5)
        corners = CAMERA.project(seen[:4, 1])
        np.testing.assert_allclose(corners, [[0, 0], [120, 0], [120, 80], [0, 80]], atol=1e-3)
        np.testing.assert_allclose(CAMERA.project(seen[4:, 0]), corners, atol=1e-3)
        np.testing.assert_allclose(CAMERA.project(seen[4:, 1]), np.roll(corners, -1, axis=0), atol=1e-3)


def test_scenes_of_any_size_have_one_size_on_the_page(page: Page):
    for depth in (1e-3, 7.0):  # the first time decides
        page.settle(depth, np.eye(4), CAMERA)
        assert page.units == pytest.approx(DEPTH_ON_PAGE / 1e-3)


def resident() -> int:
    """Memory of this process [bytes]."""
    return 4096 * int(Path("/proc/self/statm").read_text().split()[1])


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc")
def test_a_browser_that_does_not_listen_neither_blocks_nor_fills_the_memory(page: Page):
    from websockets.sync.client import connect

    count, updates = 50_000, 40  # 1.6 MB each
    rng = np.random.default_rng(0)
    address = page.url.replace("http", "ws")
    with connect(address, subprotocols=[f"viser-v{viser_version()}"], max_size=None, max_queue=1, close_timeout=0.1):
        before = resident()
        for i in range(updates):
            centres = rng.random((count, 3), dtype=np.float32)
            covariances = np.tile(np.float32(1e-3 * np.eye(3)), (count, 1, 1))
            grey = np.full((count, 3), i % 256, dtype=np.uint8)
            page.show_splats(Splats(centres, covariances, grey, grey[:, :1], count))
            page.show_frame(ShownFrame(np.eye(4), CAMERA, np.full((80, 120, 3), i % 256, dtype=np.uint8)))
        grown = resident() - before
        assert grown < 30e6  # of 64 MB that were shown


def viser_version() -> str:
    import viser

    return viser.__version__
