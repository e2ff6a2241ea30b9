"""Play a video or a folder of images as a camera, map it while it plays, and print how the map kept up.

The camera is a process of its own that sends MJPEG over HTTP on the loopback at exact times (scripts/live_camera.py).
`modp-ti run` maps the stream with `klt`, every 8th frame held out, at scale 0.5. Each call adds a row to the table of
the output folder. With a scene file instead of images, its tracker sends the frames to the socket, paced by --rate.
"""

from __future__ import annotations

import argparse
import json
import re
import socket
import subprocess
import sys
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from ending import documented_ending
from experiments import markdown_table, write_report
from live_camera import Show, add_show_options, environment, playing, read_log, show_of
from live_run import Faults, command

from modp_ti.config.scene_file import dump_scene, load_scene, scene_from_data
from modp_ti.config.settings import SceneConfig, SourceSettings
from modp_ti.files import readable
from modp_ti.files.errors import InputError
from modp_ti.inputs.opening import open_source
from modp_ti.outputs.formats.trajectory import read_trajectory

SCALE, HOLDOUT = 0.5, 8
MAX_NAME = 80
# Stands for an address that is not known yet.
ANYWHERE = "127.0.0.1:1"
# transforms.json's names of the intrinsics, by those of `source.intrinsics`.
TRANSFORMS = {"fx": "fl_x", "fy": "fl_y", "cx": "cx", "cy": "cy", "width": "w", "height": "h"}
TRANSFORMS |= {name: name for name in ("k1", "k2", "k3", "p1", "p2")}
COLUMNS = {
    "sent": ("sent", ".0f"),
    "arrived": ("arrived", ".0f"),
    "tracked": ("tracked", ".0f"),
    "lost": ("lost", ".0f"),
    "thinned": ("thinned", ".0f"),
    "largest gap [s]": ("gap", ".2f"),
    "lag, 95 % [s]": ("lag", ".2f"),
    "held-out PSNR at the end [dB]": ("psnr", ".2f"),
    "refined": ("psnr_refined", ".2f"),
    "refinement [s]": ("refinement", ".0f"),
    "saved after [s]": ("seconds_to_map", ".0f"),
}


@dataclass(frozen=True)
class Session:
    """One live session.

    Attributes:
        show: What the camera shows, or the scene file whose tracker sends its frames.
        camera: `source.intrinsics`, None for an unknown camera.
        seconds: Time of the refinement after the stream's end [s]; 0 for none.
        overrides: `KEY=VALUE` settings of the run.
        faults: Faults of the run, beside those of the camera.
    """

    show: Show
    camera: Mapping[str, float] | None
    seconds: float
    overrides: Sequence[str]
    faults: Faults

    @property
    def from_scene(self) -> bool:
        """Whether another process tracks."""
        return self.show.path.suffix.lower() in (".yaml", ".yml")

    @property
    def label(self) -> str:
        """Name of the table's row."""
        show = self.show
        count = "all" if show.frames is None else show.frames
        pace = "at its own pace" if show.rate is None else f"at {show.rate:g} a second"
        who = "socket" if self.from_scene else f"camera {'unknown' if self.camera is None else 'given'}"
        said = [who, *self.all_faults, *self.overrides]
        return ", ".join([f"{count} frames of {show.path.stem} {pace}", *said])

    @property
    def all_faults(self) -> list[str]:
        """All faults in a few words each."""
        return [*self.show.faults, *self.faults.told]

    def scene(self, stream: str, output: Path) -> dict[str, Any]:
        """Return the run's scene as plain data. `stream` is the URL of the camera, or the address of the socket."""
        source: dict[str, Any] = {"holdout": HOLDOUT}
        if not self.from_scene:
            source |= {"stream": stream, "scale": SCALE}
            source |= {} if self.camera is None else {"intrinsics": dict(self.camera)}
        tracker = {"kind": "socket", "address": stream} if self.from_scene else {"kind": "klt"}
        # `seconds` is named only if it is wanted: 0 is no time to refine in.
        refine = {"seconds": self.seconds} if self.seconds else {"steps": 0}
        return {"source": source, "tracker": tracker, "output": str(output), "device": "auto", "refine": refine}


@contextmanager
def sending(show: Show, address: str, log: Path) -> Iterator[None]:
    """Send the frames of a scene to the socket from another process, with scripts/send_frames.py."""
    program = Path(__file__).with_name("send_frames.py")
    arguments = [sys.executable, str(program), str(show.path), "--to", address, "--wait", "600"]
    arguments += [] if show.rate is None else ["--rate", str(show.rate)]
    with log.open("w", encoding="utf-8") as said:
        process = subprocess.Popen(arguments, stdout=said, stderr=said, env=environment())
        try:
            yield
        finally:
            process.terminate()
            process.wait()


def free_address() -> str:
    """Return an address on the loopback at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"127.0.0.1:{server.getsockname()[1]}"


def mapped_size(session: Session, config: SceneConfig) -> tuple[int, int]:
    """Return the size (width, height) [px] at which the session's images are mapped.

    Args:
        session: The session.
        config: Settings of its run.
    """
    show = session.show
    if session.from_scene:
        source = load_scene(show.path).source
    else:
        source = SourceSettings(path=show.path, start=show.start, stop=show.start + 1, scale=1.0)
    images = open_source(source)
    try:
        width, height = images.size(images.selected(source.start, source.stop, source.step)[0])
    finally:
        images.close()
    scale = images.scale if session.from_scene else config.source.scale_for(width, height)
    return round(width * scale), round(height * scale)


def play_and_map(session: Session, folder: Path, cold: bool = False) -> dict[str, Any]:
    """Run a session in the folder, which gets the scene, the logs and the map, and return its row.

    Args:
        session: The session.
        folder: The folder, which is created.
        cold: Do not compile the kernels before the camera plays.
    """
    output, scene = folder / "map", folder / "scene.yaml"
    # What is wrong with the settings or the images is said before anything is started.
    config = scene_from_data(session.scene(ANYWHERE, output), str(scene), session.overrides)
    width, height = mapped_size(session, config)
    session.faults.require_possible()
    temporary = folder / "tmp"
    temporary.mkdir(parents=True, exist_ok=True)
    for name in ("metrics.json", "splats.ply", "trajectory.txt"):  # of an earlier call
        (output / name).unlink(missing_ok=True)
    if not cold:
        dump_scene(config, scene)
        if command("warmup", str(scene), "--size", f"{width}x{height}", "--quiet")[0]:
            raise InputError(f"{session.label}: the kernels cannot be compiled, see above")
    with ExitStack() as sender:
        if session.from_scene:
            address = free_address()
            sender.enter_context(sending(session.show, address, folder / "sender.log"))
        else:
            address = sender.enter_context(playing(session.show, folder / "camera.json"))
        scene.write_text(yaml.safe_dump(session.scene(address, output), sort_keys=False), encoding="utf-8")
        settings = [word for setting in session.overrides for word in ("--set", setting)]
        print(f"{session.label}: mapping; see {folder / 'run.log'}", file=sys.stderr, flush=True)
        with (folder / "run.log").open("w", encoding="utf-8") as said:
            code, memory = command(
                "run", str(scene), *settings, output=said, faults=session.faults, temporary=temporary
            )
    return {**row(session, folder, code), "memory_mb": memory}


def row(session: Session, folder: Path, code: int) -> dict[str, Any]:
    """Return what the session's row says, from the files in its folder.

    Args:
        session: The session.
        folder: The folder that `play_and_map` has filled.
        code: Exit code of the run.
    """
    output, sent = folder / "map", read_log(folder / "camera.json")
    times = sent.get("times", [])
    said = (folder / "run.log").read_text(encoding="utf-8").splitlines()
    written = (output / "metrics.json").is_file()
    metrics = json.loads((output / "metrics.json").read_text(encoding="utf-8")) if written else {}
    # Runs that do not keep pace have no `live`, and rows of `figures` stay empty then.
    live = metrics.get("live") or {}
    gap = None
    # Time stamps of a peer are its own, not those of arrival.
    if not session.from_scene and (output / "trajectory.txt").is_file():
        arrivals, _ = read_trajectory(output / "trajectory.txt")
        gap = max((float(after - before) for before, after in pairwise(arrivals)), default=None)
    seconds = metrics.get("seconds", {})
    figures = {
        "sent": len(times) - times.count(None) if sent else None,
        "arrived": live.get("arrived"),
        "tracked": live.get("tracked", metrics.get("frames")),
        "lost": live.get("lost"),
        "thinned": live.get("thinned"),
        "gap": gap,
        "lag": live.get("lag_seconds", {}).get("p95"),
        "psnr": held_out_psnr(metrics, "online"),
        "psnr_refined": held_out_psnr(metrics, "refined"),
        "refinement": seconds.get("refine") if metrics.get("refined") else None,
        "seconds_to_map": live.get("seconds_to_map"),
    }
    return {
        "label": session.label,
        "faults": session.all_faults,
        "figures": figures,
        "exit_code": code,
        "map_saved": (output / "splats.ply").is_file(),
        "dropped_by_camera": times.count(None),
        "camera_late": sent.get("late"),
        "notes": [line for line in said if line.startswith(("note:", "error:"))],
        "live": live or None,
        "frames_left_out": metrics.get("frames_left_out"),
        "output": str(output),
    }


def held_out_psnr(metrics: Mapping[str, Any], stage: str) -> float | None:
    """Return the PSNR of the held-out frames [dB] in a version of the map; None if there is no such version."""
    section = metrics.get(stage)
    return None if section is None else section["held_out"]["psnr"]


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows as Markdown, and a table of how the sessions with faults ended."""
    parts = [markdown_table("stream", COLUMNS, {row["label"]: row["figures"] for row in rows})]
    notes = [
        f"- {row['label']}: {row['dropped_by_camera']} images were dropped at the camera, as nobody read them"
        for row in rows
        if row["dropped_by_camera"]
    ]
    # Images that are sent late arrive unevenly, whoever reads them.
    notes += [
        f"- {row['label']}: the camera was up to {row['camera_late']:.2f} s late: the machine had too much else to do"
        for row in rows
        if (row["camera_late"] or 0.0) > 0.05
    ]
    parts += ["\n".join(notes)] if notes else []
    failed = [row for row in rows if row["faults"] or row["exit_code"]]
    if failed:
        lines = ["| stream | exit code | map saved | said at the end |", "|---|---|---|---|"]
        for row in failed:
            said = row["notes"][-1] if row["notes"] else "–"
            lines.append(f"| {row['label']} | {row['exit_code']} | {'yes' if row['map_saved'] else 'no'} | {said} |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def given_camera(arguments: argparse.Namespace) -> dict[str, float] | None:
    """Return `source.intrinsics` from --intrinsics or --transforms, None without them. Raises InputError."""
    if arguments.transforms is not None:
        file = arguments.transforms
        with readable(file):
            text = file.read_text(encoding="utf-8")
        try:
            data = json.loads(text)
            camera = {name: float(data[key]) for name, key in TRANSFORMS.items() if data.get(key) is not None}
        except (ValueError, TypeError, AttributeError):
            raise InputError(f"{file}: is no transforms.json with the camera's numbers (--transforms)") from None
        if "fx" not in camera:
            raise InputError(f"{file}: has no `fl_x`: give --intrinsics fx=...")
        return {name: int(value) if name in ("width", "height") else value for name, value in camera.items()}
    camera = {}
    for setting in arguments.intrinsics or []:
        name, _, value = setting.partition("=")
        try:
            camera[name] = float(value)
        except ValueError:
            raise InputError(f"--intrinsics {setting}: write it as fx=525.5, as in source.intrinsics") from None
    return camera or None


def folder_name(label: str) -> str:
    """Return the name of a session's folder, no longer than file systems take."""
    name = re.sub(r"[^\w.]+", "-", label).strip("-")
    return name if len(name) <= MAX_NAME else f"{name[:MAX_NAME]}-{zlib.crc32(label.encode()):08x}"


def update(folder: Path, new: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows in the folder's live.json, with the new one in place of an earlier one of the same label."""
    file = folder / "live.json"
    rows = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else []
    return [*(row for row in rows if row["label"] != new["label"]), dict(new)]


@documented_ending()
def main() -> None:
    """Run one session, and print and write the table of all sessions in the output folder."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: scripts/live images --rate 10 --frames 600 --intrinsics fx=525.5 k1=-0.0275 -o out/live",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("path", type=Path, help="video, folder of images, or scene file whose tracker is the peer")
    add_show_options(parser)
    parser.add_argument("-o", "--output", required=True, type=Path, help="folder of the sessions and of live.md")
    parser.add_argument(
        "--intrinsics", nargs="+", metavar="KEY=VALUE", help="the camera, as source.intrinsics (default: unknown)"
    )
    parser.add_argument("--transforms", type=Path, metavar="FILE", help="transforms.json with the camera")
    parser.add_argument("--seconds", type=float, default=60.0, help="refinement after the end; 0: none (default 60)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of the run")
    parser.add_argument("--cold", action="store_true", help="do not compile the kernels before the camera plays")
    parser.add_argument(
        "--kill-tracker", type=int, metavar="N", help="kill the tracker's process (-9) when N frames are tracked"
    )
    parser.add_argument(
        "--full-disk", type=float, metavar="MB", help="the disk of the temporary folder is full after MB of frames"
    )
    arguments = parser.parse_args()
    if not arguments.path.exists():
        raise InputError(f"{arguments.path}: no such video, folder of images or scene file")
    show = show_of(arguments, arguments.path.resolve())
    faults = Faults(arguments.kill_tracker, arguments.full_disk)
    session = Session(show, given_camera(arguments), arguments.seconds, arguments.set, faults)
    if session.from_scene and (session.all_faults or session.camera or show.frames or show.start):
        raise InputError("a scene file has its own camera and frames: only --rate goes with it")
    folder = arguments.output.resolve()
    place = folder / folder_name(session.label)
    new = play_and_map(session, place, arguments.cold)
    rows = update(folder, new)
    write_report(folder, "live", table(rows), rows)
    if new["exit_code"]:
        raise InputError(f"the run ended with exit code {new['exit_code']}: see {place / 'run.log'}")


if __name__ == "__main__":
    main()
