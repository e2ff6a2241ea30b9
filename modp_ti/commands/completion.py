"""What the shell is offered where it cannot know the values itself."""

from __future__ import annotations

import re

__all__ = ["matching_settings"]


def matching_settings(incomplete: str) -> list[tuple[str, str]]:
    """`key=default` of all settings that begin so, with their meanings; of those without a plain default `key=`.

    A key that several kinds of a section have is offered once; the key that tells the kind, with each of them.
    """
    from modp_ti.config.keys import documented_keys
    from modp_ti.config.settings import SceneConfig

    found: dict[str, str] = {}
    for entry in documented_keys(SceneConfig):
        default = entry.variant if entry.selects else (entry.default or "").strip('"')
        plain = default if re.fullmatch(r"[\w./:+-]*", default) else ""
        offered = f"{entry.key}={plain}"
        if (offered if entry.selects else entry.key).startswith(incomplete):
            found.setdefault(offered, entry.description)
    return list(found.items())
