"""What scripts/benchmark.py measures: one file a kind of measurement, each run in a process of its own."""
