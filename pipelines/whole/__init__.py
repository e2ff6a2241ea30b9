"""Whole maps: continuing with finished ones, merging maps of parts, and levels of detail."""
