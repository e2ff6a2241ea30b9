"""Merging: the maps of the parts of a recording become one map."""
