"""Versions of the program, in folders: this checkout, and other commits in temporary worktrees."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from modp_ti.files.errors import InputError

ROOT = Path(__file__).resolve().parents[1]


def this_version() -> str:
    """Return the commit of this checkout, with `+` if the working tree differs from it."""
    changed = _git("status", "--porcelain", "--", "*.py", "*.toml")
    return _git("rev-parse", "--short", "HEAD") + ("+" if changed else "")


@contextmanager
def checked_out(revision: str) -> Iterator[tuple[str, Path]]:
    """Yield a commit and its folder, which is removed at the end.

    Raises:
        InputError: If git does not know the revision.
    """
    commit = _git("rev-parse", "--short", "--verify", "--quiet", revision + "^{commit}")
    with tempfile.TemporaryDirectory(prefix="version-") as folder:
        root = Path(folder) / "worktree"
        _git("worktree", "add", "--detach", "-f", str(root), commit)
        try:
            yield commit, root
        finally:
            _git("worktree", "remove", "--force", str(root))


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(f"git {' '.join(arguments)}: {done.stderr.strip() or 'no such revision'}")
    return done.stdout.strip()
