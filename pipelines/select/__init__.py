"""Which frames become keyframes, which of those a step looks at, and which frames must not touch the map."""
