"""The surface of a finished map: depth of its views from matching and from planes, fused into a distance field."""
