"""What the map is: Taichi fields and their layout. Knows no files, no losses, no loops."""

import os

# Taichi greets on import; a program that others call should not.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
