"""Compare the maps of this version of the program with those of a commit, byte for byte, on this machine.

Each recording is mapped by both versions, one after the other or at the same time on two cores. `splats.ply` and
`trajectory.txt` have to be equal, but for the comments of a header. Recordings in ../shared/data are left out where it
is absent. The exit code is 1 if a file differs.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ending import documented_ending
from versions import ROOT, checked_out

from modp_ti.files.errors import InputError

DATA = ROOT.parent / "shared" / "data"
QUICK = ["device=cpu", "mapping.optimise.steps=4", "refine.steps=40", "source.holdout=8"]
DESK = [f"source.path={DATA}/desk/images", f"tracker.path={DATA}/desk/sparse/0", *QUICK]
FOX = [f"source.path={DATA}/fox/images", f"tracker.path={DATA}/fox/sparse/0", "source.scale=0.2", *QUICK]
KITCHEN = ["source.scale=0.4", "source.step=5", "source.stop=200", f"source.path={DATA}/redkitchen/images"]
KITCHEN += [f"tracker.path={DATA}/redkitchen/sparse/0", *QUICK]
ROOM = ["source.scale=0.5", "source.stop=60", "mapping.optimise.steps=3", "refine.steps=20", "device=cpu"]
COLMAP = "source: {path: .}\ntracker: {kind: colmap, path: .}\noutput: out\n"


class Version:
    """A version of the program, and the folder that its maps go to."""

    def __init__(self, tree: Path, folder: Path) -> None:
        self.tree, self.folder = tree, folder
        self.scene = folder / "scene.yaml"
        folder.mkdir(parents=True)
        self.scene.write_text(COLMAP)

    def start(self, *arguments: object) -> subprocess.Popen[bytes]:
        """Start `modp-ti run` with these arguments; its output goes to a file."""
        command = [sys.executable, "-m", "modp_ti.run", *map(str, arguments), "--quiet"]
        environment = {**os.environ, "PYTHONPATH": str(self.tree), "PYTHONSAFEPATH": "1"}
        with (self.folder / "log.txt").open("ab") as log:
            return subprocess.Popen(command, stdout=log, stderr=log, env=environment, cwd=self.folder)

    def run(self, name: str, scene: object, settings: list[str], *options: object) -> None:
        """Map a recording to the folder `name`."""
        given = [part for setting in [*settings, f"output={self.folder / name}"] for part in ("--set", setting)]
        if self.start(scene, *given, *options).wait() != 0:
            raise InputError(f"{name}: {(self.folder / 'log.txt').read_text().strip().splitlines()[-1]}")

    def killed_and_resumed(self, name: str, settings: list[str]) -> None:
        """Kill a run after its first snapshot, and resume it."""
        given = [*settings, f"output={self.folder / name}", "snapshot_every=4"]
        running = self.start(self.scene, *(part for setting in given for part in ("--set", setting)))
        while running.poll() is None and not (self.folder / name / "snapshot.npz").exists():
            time.sleep(0.05)
        running.send_signal(signal.SIGKILL)
        running.wait()
        if self.start("--resume", self.folder / name).wait() != 0:
            raise InputError(f"{name}: {(self.folder / 'log.txt').read_text().strip().splitlines()[-1]}")

    def all(self) -> dict[str, str]:
        """Make all maps, and return the digest of each file by its name."""
        room, repeated = ROOT / "demo" / "room.mp4", [*ROOM, "source.stop=30"]
        self.run("klt", room, ROOM)
        self.run("realtime", room, [*repeated, "source.realtime=true", "export.session=true"])
        if self.start("--replay", self.folder / "realtime").wait() != 0:
            raise InputError("realtime: its session cannot be replayed")
        if DATA.exists():
            small = [*DESK, "source.scale=0.125"]
            self.run("desk", self.scene, [*DESK, "source.scale=0.25"])
            self.run("fox", self.scene, FOX)
            self.run("redkitchen", self.scene, KITCHEN)
            self.run("offline", self.scene, [*small, "mode=offline", "offline.steps=150"])
            self.run("parts", self.scene, small, "--parts", 2)
            later = [*KITCHEN, "source.start=150", "source.stop=350"]
            self.run("onto", self.scene, later, "--onto", self.folder / "redkitchen")
            self.killed_and_resumed("resumed", small)
        found = sorted(self.folder.glob("*/splats.ply")) + sorted(self.folder.glob("*/trajectory.txt"))
        return {str(file.relative_to(self.folder)): digest(file) for file in found}


def digest(file: Path) -> str:
    """Return the digest of a file, without the comments of a header."""
    lines = (line for line in file.read_bytes().split(b"\n") if not line.startswith(b"comment"))
    return hashlib.sha256(b"\n".join(lines)).hexdigest()


@documented_ending()
def main() -> None:
    """Map with both versions and compare. The exit code is 1 if a file differs, and 2 for bad input."""
    options = argparse.ArgumentParser(description=__doc__, epilog="example: scripts/same_bytes HEAD~3")
    options.add_argument("base", metavar="BASE", help="the commit to compare with")
    base = options.parse_args().base
    with checked_out(base) as (_, tree), tempfile.TemporaryDirectory(prefix="same-bytes-") as folder:
        versions = Version(tree, Path(folder) / "before"), Version(ROOT, Path(folder) / "after")
        before, after = ThreadPoolExecutor(2).map(Version.all, versions)
    names = sorted({*before, *after})
    for name in names:
        verdict = "equal" if before.get(name) == after.get(name) else "DIFFERS"
        print(f"{name:<36} {after.get(name, 'missing')[:16]} {verdict}")
    # A realtime run depends on the machine's speed: its session has to give the same map when it is repeated.
    live = [f"realtime{replayed}/splats.ply" for replayed in ("", "-replayed")]
    same = all(before.get(name) == after.get(name) for name in names if not name.startswith("realtime"))
    repeated = all(digests.get(live[0]) == digests.get(live[1]) for digests in (before, after))
    print("all equal" if same and repeated else "not equal", "" if repeated else "(a session is not repeated)")
    raise SystemExit(not (same and repeated))


if __name__ == "__main__":
    main()
