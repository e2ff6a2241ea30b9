"""One corruption over all kinds of input: a damaged file ends in one line and exit code 2, and leaves nothing."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from modp_ti.commands.app import app
from tests.samples.kinds import SAMPLES, write_sample

Corruption = Callable[[Path], object]

CASES = [(kind, file) for kind, sample in SAMPLES.items() for file in sample.files]
NUMBERS = ("nan", "inf", "1e300", "9" * 5000, "one")  # in place of a number
# A number in a table or in JSON, but not a part of a name or of a word.
NUMBER = re.compile(rb"(?<![\w./-])-?\d+(?:\.\d+)?(?:e-?\d+)?(?![\w./:-])")


def _content(change: Callable[[bytes], bytes]) -> Corruption:
    return lambda file: file.write_bytes(change(file.read_bytes()))


def _noise(data: bytes) -> bytes:
    return np.random.default_rng(len(data)).bytes(max(len(data), 64))


def _replaced_by(make: Callable[[Path], object]) -> Corruption:
    def corrupt(file: Path) -> None:
        file.unlink()
        make(file)

    return corrupt


DAMAGED: dict[str, Corruption] = {
    "empty": _content(lambda _: b""),
    "zeros": _content(lambda data: bytes(len(data))),
    "noise": _content(_noise),
    "a list of JSON": _content(lambda _: b"[[1, 2], {}]\n"),
    "a pipe": _replaced_by(os.mkfifo),
    "a device": _replaced_by(lambda file: file.symlink_to("/dev/zero")),
    "missing": Path.unlink,
}
# What is left of a file that is cut or spoilt somewhere may be whole, and be taken.
SPOILT: dict[str, Corruption] = {
    "cut in half": _content(lambda data: data[: len(data) // 2]),
    "cut at its last byte": _content(lambda data: data[:-1]),
    "noise before it": _content(lambda data: _noise(data)[:64] + data),
    "noise within": _content(lambda data: data[: len(data) // 3] + _noise(data)[:16] + data[len(data) // 3 + 16 :]),
}
# Files without which the rest is of use, if they are missing or hold nothing.
OPTIONAL = ("points3D.txt", "points3D.bin", "semidense_points.csv.gz", "semidense_observations.csv", "1.pose.txt")
OPTIONAL += (
    "frame_00003.json",
    "depth_00003.png",
    "depth000001.png",
    "1733333.json",
    "pose/1.txt",
    "depth/1.png",
    ".pincam",
)
OPTIONAL += (
    "intrinsic_depth.txt",
    "masks/frame-000001.color.png",
    "data.csv",
    "times.txt",
    "cloud_1.txt",
    "cloud_2.npy",
)
OPTIONAL += ("lowres_wide.traj",)
# What may be missing, but not be damaged.
IN_FOLDERS = ("images/",)


def _with_number(number: str, place: int) -> Corruption:
    """Replace one number of a text."""

    def change(data: bytes) -> bytes:
        found = list(NUMBER.finditer(data))
        start, end = found[place % len(found)].span()
        return data[:start] + number.encode() + data[end:]

    return _content(change)


def _is_text(data: bytes) -> bool:
    try:
        return data.decode().isprintable() or b"\n" in data
    except UnicodeDecodeError:
        return False


def _corruptions(file: str, data: bytes) -> Iterator[tuple[str, Corruption, bool]]:
    """Yield the name of each corruption, what does it, and whether it makes the input one that cannot be used."""
    for name, corrupt in DAMAGED.items():
        may_be_missing = name == "missing" and file.startswith(IN_FOLDERS)
        yield name, corrupt, not file.endswith(OPTIONAL) and not may_be_missing
    for name, corrupt in SPOILT.items():
        yield name, corrupt, False
    if _is_text(data) and NUMBER.search(data):
        for place, number in enumerate(NUMBERS):
            yield f"{number[:10]} for a number", _with_number(number, 7 * place), False


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "file"), CASES, ids=[f"{kind}-{Path(file).name}" for kind, file in CASES])
def test_a_damaged_file_ends_in_one_line(
    kind: str, file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = write_sample(kind, tmp_path / "sample").arguments
    faults = []
    data = (tmp_path / "sample" / file).read_bytes()
    for name, corrupt, is_refused in _corruptions(file, data):
        folder = tmp_path / "case"
        shutil.copytree(tmp_path / "sample", folder)
        corrupt(folder / file)
        before = set(folder.rglob("*"))
        monkeypatch.chdir(folder)
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            app(list(arguments))
        said = "".join(capsys.readouterr()).strip()
        lines = said.splitlines()
        if ended.value.code == 2:
            reasons = [line for line in lines if line.startswith(("unusable: ", "error: "))]
            # `check` prints its verdict in a second line, and more where it could read the frames.
            most = 1 + (arguments[0] == "check") if is_refused else len(lines)
            is_fine = bool(reasons) and len(lines) <= most and set(folder.rglob("*")) == before
        else:
            is_fine = ended.value.code in (0, 1) and not is_refused
        if not is_fine or "Traceback" in said:
            faults.append(f"{name}: exit code {ended.value.code}: {said[-500:]}")
        monkeypatch.undo()
        shutil.rmtree(folder)
    assert not faults, "\n".join(faults)


def test_there_is_a_sample_of_every_kind_of_tracker_that_reads_files() -> None:
    from modp_ti.config.settings import SceneConfig

    schema = json.dumps(SceneConfig.model_json_schema())
    kinds = set(re.findall(r'"const": "(\w+)"', schema)) - {"klt", "sfm", "socket", "replay"}
    kinds -= {"bag"}  # of which there is a sample a form
    assert {each for each in kinds if each not in SAMPLES} <= {"auto", "session"}, kinds - set(SAMPLES)
