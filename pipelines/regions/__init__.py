"""Regions: a finished map is refined region by region, each by the views that see it."""
