"""Measurements of scripts/benchmark.py, one file per kind. Each measurement runs in its own process."""
