"""The exception for unusable input, which the command line reports as one line with exit code 2."""

from __future__ import annotations

from modp_ti.files.urls import without_secrets

# Largest share of a recording's frames, or of a file's lines, that may be faulty. Up to it they are skipped and
# counted; above it the whole input is rejected.
FEW = 0.1


class InputError(Exception):
    """The user's input cannot be used. The message is one line that says what to change, without secrets of URLs.

    Examples:
        Report the problem without a traceback:

            try:
                config = modp_ti.load_scene("scene.yaml")
            except modp_ti.InputError as error:
                raise SystemExit(f"error: {error}")
    """

    def __init__(self, message: object = "") -> None:
        super().__init__(without_secrets(str(message)))


class UnreadableImageError(InputError):
    """An image is damaged. The run continues without it as long as at most a share `FEW` of the images is."""
