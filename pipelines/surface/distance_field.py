"""Adds depth views to a truncated signed distance field [Curless and Levoy 1996]."""
# pyright: reportInvalidTypeForm=false, reportGeneralTypeIssues=false, reportIndexIssue=false

from fields.runtime.engine import ti

IMAGE = ti.types.ndarray(dtype=ti.f32, ndim=2)
COLOURS = ti.types.ndarray(dtype=ti.f32, ndim=3)
VALUES = ti.types.ndarray(dtype=ti.f32, ndim=1)


@ti.kernel
def integrate(
    blocks: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (B, 3) first voxel of each block
    rows: ti.types.ndarray(dtype=ti.i32, ndim=1),  # (B,) first row of each block in the field
    offsets: ti.types.ndarray(dtype=ti.i32, ndim=2),  # (V, 3) voxels of a block from its first one
    voxel: ti.f32,
    K: IMAGE,
    T_camera_world: IMAGE,
    depth: IMAGE,  # 0 where unknown
    colour: COLOURS,
    truncation: ti.f32,
    farthest: ti.f32,
    free_weight: ti.f32,
    tsdf: VALUES,
    weight: VALUES,
    colours: IMAGE,
):
    """Average min((depth - z) / truncation, 1) with the voxels' values, unless it is below -1.

    A voxel that lies more than the truncation before the surface is seen to be free. Its view counts `free_weight`
    times, so that wrong surfaces in free space disappear.
    """
    each, height, width = offsets.shape[0], depth.shape[0], depth.shape[1]
    for i in range(blocks.shape[0] * each):
        b, j = i // each, i % each
        p = ti.Vector([0.0, 0.0, 0.0])
        for r in ti.static(range(3)):
            p[r] = T_camera_world[r, 3]
            for c in ti.static(range(3)):
                p[r] += T_camera_world[r, c] * voxel * (blocks[b, c] + offsets[j, c])
        if p[2] > 0.0:
            u = ti.floor(K[0, 0] * p[0] / p[2] + K[0, 2])
            v = ti.floor(K[1, 1] * p[1] / p[2] + K[1, 2])
            if u >= 0.0 and v >= 0.0 and u < width and v < height:
                x, y = ti.cast(u, ti.i32), ti.cast(v, ti.i32)
                z, w = depth[y, x], 1.0
                distance = (z - p[2]) / truncation
                if z > 0.0 and z < farthest and distance >= -1.0:
                    if distance > 1.0:
                        distance = 1.0
                        w = free_weight
                    at = rows[b] + j
                    before = weight[at]
                    share = w / ti.max(before + w, 1e-12)
                    tsdf[at] = tsdf[at] + share * (distance - tsdf[at])
                    weight[at] = before + w
                    for c in ti.static(range(3)):
                        colours[at, c] = colours[at, c] + share * (colour[y, x, c] - colours[at, c])
