"""Configuration: the settings as pydantic models, reading and writing of `scene.yaml`, documentation of its keys."""
