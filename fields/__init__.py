"""What the map is: Taichi fields and their layout. Knows no files, no losses, no loops."""
