"""What sources have in common, and the registry of those that a scene may name."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from modp_ti.config.settings import SourceSettings
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_source
from modp_ti.inputs.sources import ImageFolder, ImageSource


@pytest.fixture
def images(tmp_path) -> ImageSource:
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.zeros((6, 8, 3), np.uint8))
    return ImageFolder(tmp_path)


def test_what_few_sources_know_has_a_default(images):
    assert images.intrinsics is None and images.vignette is None and images.T_device_camera is None
    assert images.valid("0.png") is None
    assert images.frame_size == images.size("0.png") == (8, 6)
    assert list(images.arriving(1, None, 1)) == ["1.png", "2.png"] and len(images) == 3
    images.close()


def test_notes_are_added_behind_the_others_or_before_them(images):
    images.add_note("second")
    images.add_note("first", first=True)
    images.add_note("third")
    assert images.notes == ["first", "second", "third"]


def test_a_source_without_a_path_is_asked_for_one():
    with pytest.raises(InputError, match=r"source\.path is missing: set it to the folder of the images"):
        open_source(SourceSettings())
