"""A run that never was, with figures that are known, for the page to show."""

from __future__ import annotations

import base64
import dataclasses
import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fields.frames.tracked_frame import TrackedFrame
from fields.geometry.camera import PinholeCamera
from modp_ti.config.settings import ExportSettings, SceneConfig
from modp_ti.engine.results import metrics_of
from modp_ti.inputs.delivered_frames import DeliveredFrames
from modp_ti.inputs.readers.transforms import TransformsSettings
from modp_ti.inputs.source_settings import SourceSettings
from modp_ti.outputs.evaluation import FrameScore, MapVersion
from modp_ti.outputs.report.page import Album, ReportedRun
from modp_ti.outputs.report.record import RunRecord, StepNote, retention
from modp_ti.outputs.report.where_wrong import ErrorSurvey, Motion, Needles
from pipelines.pipeline import FrameReport
from pipelines.render.renderer import RenderedView


def cameras(count: int, radius: float = 1.0, height: float = 1.5) -> list[NDArray[np.float64]]:
    """T_camera_world on a circle in a world whose z is up, looking along the circle."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        centre = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        forward = np.array([-np.sin(angle), np.cos(angle), 0.0])
        R = np.stack([np.cross([0, 0, -1.0], forward), [0, 0, -1.0], forward])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, -R @ centre
        poses.append(T)
    return poses


def moved(poses: list[NDArray[np.float64]], shift: float, degrees: float) -> list[NDArray[np.float64]]:
    """The cameras, each further along the world's x and turned about its own axes."""
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    result = []
    for T in poses:
        centre = -T[:3, :3].T @ T[:3, 3] + [shift, 0, 0]
        U = np.eye(4)
        U[:3, :3] = turn @ T[:3, :3]
        U[:3, 3] = -U[:3, :3] @ centre
        result.append(U)
    return result


def gaussians(count: int) -> dict[str, NDArray[np.float32]]:
    rng = np.random.default_rng(1)
    return {
        "position": rng.uniform(-2, 2, (count, 3)).astype(np.float32),
        "opacity_logit": rng.normal(1, 2, count).astype(np.float32),
        "sh": rng.normal(0, 0.5, (count, 1, 3)).astype(np.float32),
        "log_scale": rng.normal(-4, 1, (count, 3)).astype(np.float32),
        "quaternion": rng.normal(0, 1, (count, 4)).astype(np.float32),
    }


def run_record(frames: int, holdout: int, mode: str, refine: int, keyframe_every: int) -> RunRecord:
    """Frames of 0.5 s, held-out ones of none; PSNRs that rise."""
    now = [100.0]
    record = RunRecord(clock=lambda: now[0])
    record.device = "CPU"
    record.begin()
    keyframes = 0
    for index in range(frames):
        if holdout and index % holdout == 0:
            record.frame(index, None)
            continue
        now[0] += 0.5
        is_keyframe = keyframes == 0 or index % keyframe_every == 0
        keyframes += is_keyframe
        psnr = 20.0 + 0.1 * index if is_keyframe and mode == "online" else None
        count = 100 * (index + 1) if mode == "online" else 0
        mapped = None if psnr is None else psnr + 2.0
        record.frame(index, FrameReport(index, is_keyframe, keyframes, count, psnr), mapped)
    for step in range(1, refine + 1):
        if mode == "offline":
            record.steps.append(StepNote(step, 20 + 5 * step / refine, 50 * step))
        else:
            record.steps.append(StepNote(step, 24 + 2 * step / refine))
    return record


def delivered(poses: list[NDArray[np.float64]], held_out: list[bool]) -> DeliveredFrames:
    """Black frames at T_camera_world, without points."""
    frames = DeliveredFrames()
    for i, (T, held) in enumerate(zip(poses, held_out, strict=True)):
        frames.add(dataclasses.replace(black_frame(i), T_camera_world=T, held_out=held))
    return frames


def black_frame(index: int) -> TrackedFrame:
    camera = PinholeCamera(16.0, 16.0, 8.0, 8.0, 16, 16)
    return TrackedFrame(index, index / 10, str(index), np.zeros((16, 16, 3), np.float32), camera, np.eye(4))


def made_up_run(
    folder: Path,
    frames: int = 24,
    holdout: int = 4,
    mode: str = "online",
    refine: int = 30,
    keyframe_every: int = 3,
    truth: bool = True,
    name: str = "frame {}.png",
    notes: tuple[str, ...] = (),
    size: tuple[int, int] = (48, 64),
) -> ReportedRun:
    """A run of `frames` frames; its pictures of held-out frames lie in `folder`/renders.

    holdout: 0 for none. refine: steps, or those of the offline map.
    """
    tracked = cameras(frames)
    record = run_record(frames, holdout, mode, refine, keyframe_every)
    record.notes.extend(notes)
    stages = ["offline"] if mode == "offline" else ["online", "refined"] if refine else ["online"]
    versions = {
        stage: MapVersion(
            gaussians(400 * (n + 1)), moved(tracked, 0.01 * (n + 1), n + 1.0), [None] * frames, 1000 * (n + 1)
        )
        for n, stage in enumerate(stages)
    }
    held_out = [bool(holdout) and index % holdout == 0 for index in range(frames)]
    scores = [
        FrameScore(i, name.format(i), held_out[i], stage, 25 + n + 3 * np.sin(i), 0.9 + 0.01 * n, None, 0.6 + 0.1 * n)
        for n, stage in enumerate(stages)
        for i in range(frames)
    ]
    keyframes = [note.index for note in record.frames if note.is_keyframe]
    seconds = {
        "compile": 2.0,
        "read": 1.0,
        "optimise": 12.5,
        "evaluate": 3.25,
        "refine": refine if mode == "online" else 0,
        "total": 60.0,
    }
    metrics = {
        "keyframes": len(keyframes),
        "gaussians": len(versions[stages[-1]].gaussians["position"]),
        "frames_per_second": 1.875,
        "peak_memory_mb": 1234.5,
        "ate_rmse": 0.0123 if truth else None,
        "ate_rmse_rigid": 0.0234 if truth else None,
        "ate_rmse_tracked": 0.0345 if truth else None,
        **metrics_of(scores, versions, keyframes, delivered(tracked, held_out), seconds),
        "retention": retention(record.frames, scores),
    }
    album = Album.of(held_out)
    (folder / "renders").mkdir(exist_ok=True)
    for i in range(frames):
        if not held_out[i] and i not in album.wanted:
            continue
        image, render = picture(i, size), picture(i + 1000, size)
        if held_out[i]:
            pair = np.round(np.hstack([image, render])[..., ::-1] * 255).astype(np.uint8)
            cv2.imwrite(str(folder / "renders" / f"{i:06d}.png"), pair)
        album.keep(i, image, render)
    survey = ErrorSurvey(any(held_out))
    for i in range(frames):
        frame = dataclasses.replace(black_frame(i), image=picture(i, (16, 16)))
        motion = Motion.at(tracked, keyframes, frame)
        if held_out[i] == survey.held_out and motion is not None:
            flat = np.ones((16, 16), np.float32)
            survey.add(frame, RenderedView(picture(i + 1000, (16, 16)), (1 + i) * flat, flat), motion)
    config = SceneConfig(
        tracker=TransformsSettings(),
        source=SourceSettings(path=folder / "images", scale=0.5, holdout=holdout or None),
        export=ExportSettings(),
        output=folder / "out",
        mode=mode,
    )
    return ReportedRun(
        config=config,
        record=record,
        metrics=metrics,
        scores=scores,
        versions=versions,
        tracked=tracked,
        truth=moved(tracked, 0.0, 0.0) if truth else [],
        keyframes=keyframes,
        scene_depth=2.0,
        comparisons=album.comparisons([s for s in scores if s.stage == stages[-1]], folder / "renders"),
        survey=survey,
        needles=Needles.of(versions[stages[-1]].gaussians, [(black_frame(i).camera, tracked[i]) for i in keyframes]),
    )


def picture(seed: int, size: tuple[int, int]) -> NDArray[np.float32]:
    """Colours (H, W, 3) in [0, 1] that differ by the seed and change slowly."""
    coarse = np.random.default_rng(seed).random((4, 4, 3)).astype(np.float32)
    return np.clip(cv2.resize(coarse, size[::-1], interpolation=cv2.INTER_LINEAR), 0, 1)


class Page(HTMLParser):
    """A page taken apart: its tags must be closed in their order. tables: rows of cells, by the section's id."""

    VOID = ("meta", "img", "br", "link", "input", "hr")

    def __init__(self, html: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.text: list[str] = []
        self.styles: list[str] = []
        self.section = ""
        self.tables: dict[str, list[list[str]]] = {}
        self.images: list[dict[str, str]] = []
        self.feed(html)
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, key, value or "") for key, value in attributes]
        named = {key: value or "" for key, value in attributes}
        if tag == "section":
            self.section = named.get("id", "")
        if tag == "img":
            self.images.append(named | {"section": self.section})
        if tag == "tr":
            self.tables.setdefault(self.section, []).append([])
        if tag in ("td", "th"):
            self.tables[self.section][-1].append("")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "style":
            self.styles.append(data)
            return
        if any(tag in ("td", "th") for tag in self.open):
            self.tables[self.section][-1][-1] += data.strip()
        if data.strip():
            self.text.append(" ".join(data.split()))

    def embedded(self, section: str, kind: str) -> list[bytes]:
        """The pictures of a kind ("jpeg", "svg+xml", "png") that a section holds."""
        start = f"data:image/{kind};base64,"
        sources = [image["src"] for image in self.images if image["section"] == section]
        return [base64.b64decode(source.removeprefix(start)) for source in sources if source.startswith(start)]

    def curves(self) -> dict[str, list[NDArray[np.float64]]]:
        """The points (N, 2) of every named curve of the drawings, in the drawing's own units."""
        found: dict[str, list[NDArray[np.float64]]] = {}
        for section in {image["section"] for image in self.images}:
            for svg in self.embedded(section, "svg+xml"):
                named = re.findall(r'<g id="([a-z-]+)">\s*<path d="([^"]*)"', svg.decode("utf-8"))
                for name, path in named:
                    points = re.findall(r"[ML] (\S+) (\S+)", path)
                    found.setdefault(name, []).append(np.array(points, dtype=float))
        return found
