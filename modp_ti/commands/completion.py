"""Shell completion of values that depend on the settings."""

from __future__ import annotations

import re

__all__ = ["matching_settings"]


def matching_settings(incomplete: str) -> list[tuple[str, str]]:
    """Complete `--set KEY=VALUE`.

    Settings with a plain default are offered as `key=default`, others as `key=`. A key that several kinds of a section
    have is offered once. A key that selects the kind is offered with each kind.

    Args:
        incomplete: The text before the cursor.

    Returns:
        Completions with the meanings of their keys.
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
