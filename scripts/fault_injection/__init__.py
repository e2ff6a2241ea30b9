"""Fault injection: malformed files, killed runs, disturbed streams."""
