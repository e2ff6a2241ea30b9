"""Trouble made on purpose: malformed files, killed runs, disturbed streams."""
