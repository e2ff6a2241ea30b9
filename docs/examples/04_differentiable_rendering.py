"""Render Gaussians as a differentiable PyTorch function, and find a camera pose by gradient descent."""

import torch
from textured_plane import HEIGHT, INTRINSICS, WIDTH

import modp_ti

modp_ti.initialise("cpu")
camera = modp_ti.PinholeCamera(*INTRINSICS, WIDTH, HEIGHT)

# Coloured Gaussians in front of the camera, in the stored form of 3DGS files.
generator = torch.Generator().manual_seed(0)
n = 300
gaussians = {
    "position": torch.rand(n, 3, generator=generator) * torch.tensor([4.0, 3.0, 2.0]) + torch.tensor([-2.0, -1.5, 3.0]),
    "log_scale": torch.full((n, 3), 0.12).log(),
    "quaternion": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),  # w, x, y, z
    "opacity_logit": torch.logit(torch.full((n,), 0.8)),
    "colour": torch.rand(n, 3, generator=generator),
}
true_pose = torch.eye(4)
with torch.no_grad():
    truth = modp_ti.rasterize(**gaussians, T_camera_world=true_pose, camera=camera).image

# Start from a wrong pose. Optimise a tangent (translation, then rotation) that is applied on the left.
start = modp_ti.torch_exp_se3(torch.tensor([0.08, -0.05, 0.05, 0.01, 0.02, -0.02])) @ true_pose
xi = torch.zeros(6, requires_grad=True)
adam = torch.optim.Adam([xi], lr=4e-3)
losses = []
for _ in range(100):
    T_camera_world = modp_ti.torch_exp_se3(xi) @ start
    view = modp_ti.rasterize(**gaussians, T_camera_world=T_camera_world, camera=camera)
    loss = (view.image - truth).abs().mean()
    adam.zero_grad()
    loss.backward()
    adam.step()
    losses.append(loss.item())

found_pose = (modp_ti.torch_exp_se3(xi) @ start).detach()
error_before = (start - true_pose).abs().max().item()
error_after = (found_pose - true_pose).abs().max().item()
print(f"loss {losses[0]:.4f} -> {losses[-1]:.4f}, largest error of the pose {error_before:.3f} -> {error_after:.4f}")
