"""Refining: a finished map is refined region by region, by tasks that run side by side."""
