"""A finished map seen again: read from its folder, loaded into the renderer, flown through, filmed."""
