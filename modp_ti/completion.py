"""What the shell is offered where it cannot know the values itself."""

from __future__ import annotations

import re

__all__ = ["matching_settings"]


def matching_settings(incomplete: str) -> list[tuple[str, str]]:
    """`key=default` of all settings that begin so, with their meanings; of those without a plain default `key=`."""
    from modp_ti.config_keys import documented_keys
    from modp_ti.settings import SceneConfig

    found = []
    for entry in documented_keys(SceneConfig):
        default = (entry.default or "").strip('"')
        plain = default if re.fullmatch(r"[\w./:+-]*", default) else ""
        if entry.key.startswith(incomplete):
            found.append((f"{entry.key}={plain}", entry.description))
    return found
