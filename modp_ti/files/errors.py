"""The exception for unusable input, and URLs without the secrets that they may hold."""

from __future__ import annotations

import os
import re
from pathlib import Path

# Also with one slash, as a `Path` of a URL has.
URL = re.compile(r"([a-z][a-z0-9+.-]+:/{1,2})(.*)", re.IGNORECASE | re.DOTALL)
URL_IN_TEXT = re.compile(r"""(?<![\w.+-])[a-z][a-z0-9+.-]+:/{1,2}[^\s"'<>]*[^\s"'<>:;,.)]""", re.IGNORECASE)
HOST = re.compile(r"(\[[0-9a-f:.%]+\]|[\w.-]*)(:\d{1,5})?(?=[/?#]|$)", re.IGNORECASE)
FROM_ENVIRONMENT, FROM_FILE = "from-env:", "from-file:"


def shown_url(url: str) -> str:
    """Return a URL without user, password, query and fragment; other text as it is.

    A password may hold any character, and ends at the last `@`. Where it is not clear what is the host, because a path
    or query holds an `@` too, nothing but the scheme is left.
    """
    found = URL.fullmatch(url)
    if found is None:
        return url
    scheme, rest = found.groups()
    authority, place = re.split("[/?#]", rest, maxsplit=1)[0], rest.rpartition("@")[2]
    if scheme.lower().startswith("file:"):  # a path of this machine, in which an `@` is a letter
        place = rest
    elif not HOST.match(place) or ("@" in rest[len(authority) :] and HOST.fullmatch(authority)):
        return f"{scheme}..."
    return scheme + re.split("[?#]", place, maxsplit=1)[0]


def without_secrets(text: str) -> str:
    """Return a text in which each URL is as `shown_url` shows it."""
    return URL_IN_TEXT.sub(lambda found: shown_url(found[0]), text)


def actual_url(setting: str) -> str:
    """Return the URL that a setting means: itself, the content of `from-env:NAME` or of `from-file:PATH`.

    Raises:
        InputError: If there is no such environment variable or file.
    """
    if setting.startswith(FROM_ENVIRONMENT):
        name = setting.removeprefix(FROM_ENVIRONMENT)
        if not os.environ.get(name):
            raise InputError(f"{setting}: the environment variable {name} is not set; set it to the whole URL")
        return os.environ[name].strip()
    if setting.startswith(FROM_FILE):
        try:
            return Path(setting.removeprefix(FROM_FILE)).expanduser().read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError):
            raise InputError(f"{setting}: cannot be read; it is a text file with the whole URL") from None
    return setting


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
