"""Readers and writers of the output files, one module per format."""
