"""Libraries: one zlib, and no word of pycolmap on the terminal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PATIENCE

pytestmark = pytest.mark.slow


CODE = """
import {order}
import gzip, sys, numpy as np, pycolmap, cv2
from modp_ti.files.atomic import write_picture
image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
write_picture(sys.argv[1], image)
assert (cv2.imread(sys.argv[1])[..., ::-1] == image).all()
assert gzip.decompress(gzip.compress(image.tobytes())) == image.tobytes()
pycolmap.Bitmap.from_array(image).write(sys.argv[1])
assert (cv2.imread(sys.argv[1])[..., ::-1] == image).all()
"""


@pytest.mark.parametrize("order", ["pycolmap, cv2, modp_ti", "modp_ti, pycolmap"])
def test_pictures_are_written_whatever_is_imported_first(order: str, tmp_path) -> None:
    code = CODE.format(order=order)
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "picture.png")],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stderr


TERMINATED = """
import os, signal, threading, time
def load():
    from modp_ti.files.quiet_pycolmap import pycolmap
    assert pycolmap.Reconstruction
{load}
os.kill(os.getpid(), signal.SIGTERM)
time.sleep(60)
"""

IN_MAIN = "load()"

IN_THREAD = "thread = threading.Thread(target=load); thread.start(); thread.join()"

# Points so near the cameras that the normal equations have no Cholesky factorization, from an observation that is not
# one: Ceres warns of the former at every step, and tells of the latter as an error.
DEGENERATE = """
import numpy as np
from modp_ti.inputs.klt.camera import Lens
from modp_ti.inputs.multiview.bundle_adjustment import adjusted_bundle
camera = Lens.radial(100.0, 0.0, 100, 100).camera
draw = np.random.default_rng(0)
poses = {i: np.eye(4) for i in range(3)}
for i in poses:
    poses[i][0, 3] = i
xyz = (draw.normal(size=(20, 3)) + [0.0, 0.0, 5.0]) * [1.0, 1.0, 1e-12]
view, point, pixels = np.repeat(np.arange(3), 20), np.tile(np.arange(20), 3), draw.uniform(0.0, 100.0, (60, 2))
adjusted_bundle(camera, poses, view, point, pixels, xyz, {1, 2}, 50)
pixels[0] = np.nan
assert adjusted_bundle(camera, poses, view, point, pixels, xyz, {1, 2}, 50) is None
"""


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """The code in a process of its own, whose folder for temporary files is `folder`."""
    inherited = {key: value for key, value in os.environ.items() if not key.startswith("GLOG_")}
    variables = {**inherited, "TMPDIR": str(folder)}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=variables, timeout=PATIENCE)


@pytest.mark.parametrize("load", [IN_MAIN, IN_THREAD], ids=["in the main thread", "in another"])
def test_a_terminated_process_dies_of_the_signal_without_a_stack_trace(load: str, tmp_path: Path) -> None:
    ended = run(TERMINATED.format(load=load), tmp_path)
    assert (ended.returncode, ended.stdout, ended.stderr) == (-signal.SIGTERM, "", "")


def test_an_adjustment_of_which_ceres_warns_is_silent_and_leaves_no_file(tmp_path: Path) -> None:
    ended = run(DEGENERATE, tmp_path)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []
