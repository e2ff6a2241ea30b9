"""Writes the page; see the package."""

from __future__ import annotations

import base64
import os
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from numpy.typing import NDArray

from modp_ti.files.atomic import replace_text
from modp_ti.outputs.formats.sog import sog_bytes

__all__ = ["write_splat_page", "write_streaming_page"]


def write_splat_page(
    path: str | os.PathLike[str], name: str, state: Mapping[str, NDArray], settings: Mapping[str, Any]
) -> None:
    """Write a self-contained page that shows Gaussians.

    The page holds SuperSplat's viewer (2.1 MB) and the map as `.sog` in base 85, which takes 25 percent more than its
    bytes. A browser opens it from the disk, and requests nothing.

    Args:
        path: The file.
        name: Title of the page.
        state: Gaussians by name, as from `GaussianField.to_numpy`, with y down.
        settings: The viewer's settings, see `viewer_settings`.
    """
    _write(path, name, settings, sog_bytes(state))


def write_streaming_page(path: str | os.PathLike[str], name: str, settings: Mapping[str, Any]) -> None:
    """Write a page that shows the map of the `lod-meta.json` beside it, and loads what it shows from its server.

    Args:
        path: The file.
        name: Title of the page.
        settings: The viewer's settings, see `viewer_settings`.
    """
    _write(path, name, settings, None)


def _write(path: str | os.PathLike[str], name: str, settings: Mapping[str, Any], content: bytes | None) -> None:
    import jinja2
    from markupsafe import Markup

    vendored = files("modp_ti.outputs.splat_page") / "supersplat"
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("modp_ti.outputs.splat_page", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
    )
    page = environment.get_template("page.html.j2").render(
        name=name,
        css=Markup((vendored / "viewer.min.css").read_text("utf-8")),
        js=Markup((vendored / "viewer.min.js").read_text("utf-8")),
        settings=settings,
        map=None if content is None else _text(content),
        length=len(content or b""),
    )
    replace_text(path, page)


def _text(content: bytes):
    """Return bytes as text for an element of the page."""
    from markupsafe import Markup

    # Without "<", nothing in it can end the element. The padding makes whole words of four bytes.
    return Markup(base64.b85encode(content + bytes(-len(content) % 4)).decode("ascii").replace("<", ","))
