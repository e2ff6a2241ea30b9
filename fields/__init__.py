"""The data of the map: Taichi fields and their layout. Independent of files, losses and pipelines."""

import os

# A library should not print Taichi's greeting when it is imported.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
