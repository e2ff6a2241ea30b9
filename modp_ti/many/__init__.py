"""Many runs: batches of recordings and recordings in parts, each run a process, on this machine or on a Ray cluster."""
