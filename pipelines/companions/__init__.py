"""Companions of the paper's loop: paging, places, hidden Gaussians, masks of what moves, and the pace."""
