"""Thin a point cloud with the multi-level occupancy voxels alone."""

import numpy as np

import modp_ti

modp_ti.initialise("cpu")
voxels = modp_ti.OccupancyVoxels(coarsest=1.0, levels=8)  # cell sizes 1, 1/2, ..., 1/128

# Points on a sphere of radius 2, scanned twice with some noise.
rng = np.random.default_rng(0)
directions = rng.normal(size=(20_000, 3))
sphere = 2.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
first_scan = sphere + rng.normal(scale=0.002, size=sphere.shape)
second_scan = sphere + rng.normal(scale=0.002, size=sphere.shape)

# `admit` keeps the first point of every empty cell and marks the cell.
kept = first_scan[voxels.admit(first_scan, 0.125)]
new = second_scan[voxels.admit(second_scan, 0.125)]
print(f"first scan: {len(kept)} of {len(first_scan)} points kept; the second adds {len(new)}")

# `query` only asks. A finer spacing leaves room between the points that were kept.
occupied = voxels.query(second_scan, 0.125)
occupied_finer = voxels.query(second_scan, 0.02)
print(f"occupied at 0.125: {occupied.mean():.0%}, at 0.02: {occupied_finer.mean():.0%}")

# The spacing may differ from point to point: here it grows with the distance from a camera at x = -4.
voxels.clear()
spacing = np.linalg.norm(first_scan - [-4.0, 0.0, 0.0], axis=1) / 32
kept_by_distance = first_scan[voxels.admit(first_scan, spacing)]
near = (kept_by_distance[:, 0] < 0).sum()
print(f"near half of the sphere: {near} points, far half: {len(kept_by_distance) - near}")
