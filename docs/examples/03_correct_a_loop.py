"""Send corrected poses after a loop closure: the Gaussians move with the frames that placed them."""

import numpy as np
import textured_plane

import modp_ti

modp_ti.initialise("cpu")
mapper = modp_ti.Mapper(width=textured_plane.WIDTH, height=textured_plane.HEIGHT)


def drift(i: int) -> np.ndarray:
    """Return the motion (4, 4) of the world that the tracker has accumulated at frame i: it slides to one side."""
    T = np.eye(4)
    T[0, 3] = 0.03 * i
    return T


# The tracker drifts: its poses and its points are off by a little more in every frame.
frames = list(textured_plane.observe(8))
for i, observed in enumerate(frames):
    drifted_pose = observed.T_camera_world @ np.linalg.inv(drift(i))
    drifted_xyz = observed.xyz + drift(i)[:3, 3]
    frame = modp_ti.TrackedFrame.from_arrays(
        i, observed.image, drifted_pose, textured_plane.INTRINSICS, drifted_xyz, observed.pixels, observed.ids
    )
    mapper.add(frame)


def position_errors() -> np.ndarray:
    """Return the distance of every refined camera centre from the true one [scene units]."""
    estimated = [np.linalg.inv(T)[:3, 3] for T in mapper.trajectory()]
    true = [np.linalg.inv(observed.T_camera_world)[:3, 3] for observed in frames]
    return np.linalg.norm(np.subtract(estimated, true), axis=1)


view_before = mapper.render(frame.camera, frames[-1].T_camera_world).colour
errors_before = position_errors()

# The loop closes. The correction names the frames whose poses changed, and the points that moved, by their ids.
ids = np.unique(np.concatenate([observed.ids for observed in frames]))
true_xyz = {i: xyz for observed in frames for i, xyz in zip(observed.ids.tolist(), observed.xyz, strict=True)}
mapper.correct(
    modp_ti.PoseCorrection(
        index=np.arange(len(frames)),
        T_camera_world=np.stack([observed.T_camera_world for observed in frames]),
        ids=ids,
        xyz=np.stack([true_xyz[i] for i in ids.tolist()]),
    )
)

view_after = mapper.render(frame.camera, frames[-1].T_camera_world).colour
errors_after = position_errors()
psnr_before = textured_plane.psnr(view_before, frames[-1].image)
psnr_after = textured_plane.psnr(view_after, frames[-1].image)
print(f"error of the last camera: {errors_before[-1]:.3f} -> {errors_after[-1]:.3f} scene units")
print(f"the map from the true last pose: {psnr_before:.2f} -> {psnr_after:.2f} dB")
