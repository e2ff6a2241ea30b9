"""The checks of `modp-ti check`: frames, time stamps, images, and whether poses and intrinsics fit them."""
