"""Depth estimation at pixels without a tracked point: a protocol, several sources, and their fusion."""
