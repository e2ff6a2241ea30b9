"""What moves: parts of images that the map, made of all views, contradicts."""
