"""The one exception that the command line turns into a line of text and exit code 2."""

__all__ = ["InputError"]


class InputError(Exception):
    """Something the user gave cannot be used. The message is one line and says how to mend it."""
