"""A recording of three images of 48x36 pixels: a camera moves to the right in front of forty points on a wall."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

WIDTH, HEIGHT, FOCAL, FRAMES = 48, 36, 40.0, 3
INTRINSICS = f"intrinsics: {{fx: {FOCAL}, cx: {WIDTH / 2}, cy: {HEIGHT / 2}}}"
NAMES = [f"frame-{i:06d}.color.png" for i in range(FRAMES)]


def wall() -> np.ndarray:
    """Return the points (40, 3) on the wall."""
    rng = np.random.default_rng(7)
    return np.c_[rng.uniform(-1.2, 1.2, 40), rng.uniform(-0.9, 0.9, 40), rng.uniform(2.5, 3.5, 40)]


def position(i: int) -> float:
    """Return the x coordinate of the camera in image i."""
    return 0.1 * i


def pixels_on(i: int) -> np.ndarray:
    """Return the pixels (40, 2) of the points in image i."""
    p = wall() - (position(i), 0.0, 0.0)
    return FOCAL * p[:, :2] / p[:, 2:] + (WIDTH / 2, HEIGHT / 2)


def seen_on(i: int) -> np.ndarray:
    """Return the indices (N,) of the points that image i contains."""
    p = pixels_on(i)
    return np.flatnonzero(((p > 0) & (p < (WIDTH, HEIGHT))).all(axis=1))


def picture(i: int) -> np.ndarray:
    """Return image i (H, W, 3), a pattern that moves with the camera."""
    texture = np.random.default_rng(3).integers(0, 255, (HEIGHT // 4 + 1, WIDTH // 4 + 4, 3), dtype=np.uint8)
    large = cv2.resize(texture, None, fx=4, fy=4, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(large[:HEIGHT, i : i + WIDTH])


def write_text(folder: Path, name: str, lines: list[str]) -> None:
    """Write a text file with these lines below the folder."""
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines) + "\n")


def write_bytes(folder: Path, name: str, data: bytes) -> None:
    """Write a binary file below the folder."""
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(data)


def scene_file(folder: Path, tracker: str, source: str = f"path: images, {INTRINSICS}") -> None:
    """Write a `scene.yaml` with this tracker and source."""
    write_text(folder, "scene.yaml", [f"source: {{{source}}}", f"tracker: {{{tracker}}}", "output: out", "device: cpu"])


def write_images(folder: Path, names: list[str] = NAMES, inside: str = "images") -> None:
    """Write the images in the formats given by their names."""
    for i, name in enumerate(names):
        suffix = Path(name).suffix
        heif = suffix in (".avif", ".heic")
        write_bytes(
            folder, f"{inside}/{name}", _heif(i, suffix) if heif else cv2.imencode(suffix, picture(i))[1].tobytes()
        )


def _heif(i: int, suffix: str) -> bytes:
    image = Image.fromarray(picture(i)[..., ::-1])
    with io.BytesIO() as stream:
        if suffix == ".avif":
            image.save(stream, "AVIF")
        else:
            import pillow_heif

            pillow_heif.from_pillow(image).save(stream)
        return stream.getvalue()


def tum_line(i: int) -> str:
    """Return the line of image i in a TUM trajectory."""
    return f"{i / 30:.6f} {position(i)} 0 0 0 0 0 1"


def points_file(folder: Path) -> None:
    """Write the points as text to `points.txt`."""
    write_text(folder, "points.txt", [" ".join(f"{v:.6f}" for v in row) for row in wall()])


def points_ply() -> bytes:
    """Return the points as a binary PLY."""
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 40\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    return (header + "end_header\n").encode() + wall().astype("<f4").tobytes()
