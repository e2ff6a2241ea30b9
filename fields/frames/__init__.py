"""What a tracker hands over: frames with their poses and points, and corrections of poses."""
