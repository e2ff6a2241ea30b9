"""The configuration: its settings as models, `scene.yaml` read and written, and the documentation of its keys."""
