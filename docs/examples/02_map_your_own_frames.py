"""Map frames from your own loop while they arrive, then render the map from a new viewpoint."""

import cv2
import numpy as np
import textured_plane

import modp_ti

modp_ti.initialise("cpu")
mapper = modp_ti.Mapper(width=textured_plane.WIDTH, height=textured_plane.HEIGHT)  # the largest image that will come

for i, observed in enumerate(textured_plane.observe(8)):
    frame = modp_ti.TrackedFrame.from_arrays(
        i,
        observed.image,
        observed.T_camera_world,
        textured_plane.INTRINSICS,
        observed.xyz,
        observed.pixels,
        observed.ids,
    )
    report = mapper.add(frame)
    print(f"frame {i}: keyframe {report.is_keyframe}, {report.gaussians} Gaussians")
mapper.refine(50)
mapper.save("out/own_frames")  # splats.ply, trajectory.txt, frames.json and colmap/

# A viewpoint half-way between two frames.
T_camera_world = textured_plane.pose(0.5)
view = mapper.render(frame.camera, T_camera_world)
psnr = textured_plane.psnr(view.colour, textured_plane.draw(T_camera_world))
depth = view.expected_depth()  # z in scene units, 0 where the map is thin
print(f"new view: PSNR {psnr:.2f} dB, depth {depth[depth > 0].min():.2f} to {depth.max():.2f}")

picture = np.round(255 * np.clip(view.colour, 0, 1)).astype(np.uint8)
cv2.imwrite("out/new_view.png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
