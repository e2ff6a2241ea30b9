"""Map a folder of images with the trajectory and the points that another program wrote, and read the results.

This is what `modp-ti run scene.yaml` does, called from Python.
"""

import json
from pathlib import Path

import cv2
import numpy as np
import textured_plane

import modp_ti

# The input: images named by their index, a trajectory in TUM's format (camera to world) and a text file of points.
data = Path("out/plane")
(data / "images").mkdir(parents=True, exist_ok=True)
trajectory, points = [], {}
for i, frame in enumerate(textured_plane.observe(12)):
    cv2.imwrite(str(data / "images" / f"{i:04d}.png"), cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
    T_world_camera = np.linalg.inv(frame.T_camera_world)
    half_angle = np.arctan2(T_world_camera[0, 2], T_world_camera[0, 0]) / 2  # this camera turns around y only
    quaternion = (0.0, np.sin(half_angle), 0.0, np.cos(half_angle))  # x, y, z, w
    trajectory.append(" ".join(map(str, (i / 30, *T_world_camera[:3, 3], *quaternion))))
    points.update(zip(frame.ids.tolist(), frame.xyz.tolist(), strict=True))
(data / "trajectory.txt").write_text("\n".join(trajectory) + "\n")
(data / "points.txt").write_text("\n".join(f"{x} {y} {z}" for x, y, z in points.values()) + "\n")

# The scene file. Paths are relative to it; every 6th frame is held out for evaluation.
scene = data / "scene.yaml"
scene.write_text(
    """\
source:
  path: images
  holdout: 6
  intrinsics: {fx: 90.0, width: 96, height: 72}
tracker: {kind: tum, path: trajectory.txt, points: points.txt}
output:  map
device:  cpu
refine:  {steps: 50}
"""
)

# Any setting can be overridden, as with `--set` on the command line.
config = modp_ti.load_scene(scene, ["mapping.densify.pixels=2000"])
output = modp_ti.run_scene(config)

metrics = json.loads((output / "metrics.json").read_text())
held_out = metrics["refined"]["held_out"]
print(f"{metrics['frames']} frames, {metrics['keyframes']} keyframes, {metrics['gaussians']} Gaussians")
print(f"held-out frames: PSNR {held_out['psnr']:.2f} dB, SSIM {held_out['ssim']:.3f}")
print(f"the report is {output / 'report.html'}")
