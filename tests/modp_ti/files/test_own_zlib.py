"""Compression works in whatever order pycolmap, OpenCV and this package are imported."""

from __future__ import annotations

import subprocess
import sys

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
