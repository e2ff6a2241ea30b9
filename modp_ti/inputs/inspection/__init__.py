"""What `modp-ti check` looks at: frames, times, pictures, and whether poses and intrinsics fit them."""
