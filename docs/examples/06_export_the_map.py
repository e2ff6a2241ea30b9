"""Take a map elsewhere: splats for viewers, Gaussians as NumPy arrays, and a mesh fused from rendered depth."""

from pathlib import Path

import numpy as np
import open3d as o3d
import textured_plane

import modp_ti

modp_ti.initialise("cpu")
mapper = modp_ti.Mapper(width=textured_plane.WIDTH, height=textured_plane.HEIGHT)
for i, observed in enumerate(textured_plane.observe(8)):
    arrays = (observed.image, observed.T_camera_world, textured_plane.INTRINSICS, observed.xyz, observed.pixels)
    frame = modp_ti.TrackedFrame.from_arrays(i, *arrays)
    mapper.add(frame)
mapper.refine(50)

# The Gaussians as a 3DGS PLY file, for any splat viewer.
out = Path("out")
splats = mapper.save(out / "splats.ply")

# The same file as arrays: keep the opaque Gaussians and write them to a file of their own.
gaussians = modp_ti.read_splats(splats)
opaque = gaussians["opacity_logit"] > 0  # opacity above 0.5
modp_ti.write_splats(out / "opaque.ply", {name: values[opaque] for name, values in gaussians.items()})
print(f"{len(opaque)} Gaussians, {opaque.sum()} of them opaque")

# A mesh: render colour and depth from every frame, and fuse them into a truncated signed distance field.
# `modp-ti export OUT --format mesh` makes a better one from a finished run: it also matches the images.
core = o3d.core
grid = o3d.t.geometry.VoxelBlockGrid(
    attr_names=("tsdf", "weight", "color"),
    attr_dtypes=(core.float32, core.float32, core.float32),
    attr_channels=((1), (1), (3)),
    voxel_size=0.04,
)
K, farthest = core.Tensor(frame.camera.matrix()), 20.0
for T_camera_world in mapper.trajectory():
    view = mapper.render(frame.camera, T_camera_world)
    depth = o3d.t.geometry.Image(core.Tensor(view.expected_depth()[..., None].astype(np.float32)))
    colour = o3d.t.geometry.Image(core.Tensor(np.clip(view.colour, 0, 1).astype(np.float32)))
    T = core.Tensor(T_camera_world)
    blocks = grid.compute_unique_block_coordinates(depth, K, T, depth_scale=1.0, depth_max=farthest)
    grid.integrate(blocks, depth, colour, K, K, T, depth_scale=1.0, depth_max=farthest)
mesh = grid.extract_triangle_mesh(weight_threshold=2.0).to_legacy()
o3d.io.write_triangle_mesh(str(out / "mesh.ply"), mesh)

vertices = np.asarray(mesh.vertices)
distance = np.abs(vertices @ textured_plane.NORMAL - textured_plane.OFFSET) / np.linalg.norm(textured_plane.NORMAL)
print(f"{len(vertices)} vertices, median distance from the plane {np.median(distance):.4f} scene units")
