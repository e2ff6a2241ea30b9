"""What a run leaves: one file per output format."""
