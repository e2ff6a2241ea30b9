"""The one exception that the command line turns into a line of text and exit code 2."""

__all__ = ["FEW", "InputError", "UnreadableImageError"]

# Share of a recording's frames, or of a file's lines, that may be faulty: they are left out and counted. Of more the
# whole input is taken to be wrong.
FEW = 0.1


class InputError(Exception):
    """Something the user gave cannot be used. The message is one line and says how to mend it."""


class UnreadableImageError(InputError):
    """An image is damaged. Where it is one of few, the run goes on without it."""
