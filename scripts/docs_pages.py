"""MkDocs hooks that add to the Markdown pages of docs/.

- CONTRIBUTING.md and CHANGELOG.md in the project's root become pages.
- A link to an example program on its own line is followed by the program's code.
- `::: modp_ti.NAME` documents the public name wherever it is defined. A public name without an entry causes a warning,
  which scripts/docs treats as an error.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.plugins import get_plugin_logger
from mkdocs.structure.files import File, Files

import modp_ti

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = re.compile(r"^\[`(\w+\.py)`\]\(\1\)$", re.MULTILINE)
ENTRY = re.compile(r"^::: modp_ti\.(\w+)$", re.MULTILINE)

log = get_plugin_logger(__name__)
documented: set[str] = set()


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are stored outside docs/."""
    for name in ("CONTRIBUTING.md", "CHANGELOG.md"):
        text = (ROOT / name).read_text(encoding="utf-8").replace("](docs/", "](")
        files.append(File.generated(config, name.lower(), content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Insert the example programs, and resolve public names and links to pages outside docs/."""
    folder = Path(config.docs_dir, page.file.src_uri).parent
    markdown = markdown.replace("](../CONTRIBUTING.md)", "](contributing.md)")
    markdown = PROGRAM.sub(lambda link: _with_program(link, folder), markdown)
    return ENTRY.sub(_resolved, markdown)


def on_env(env: Any, config: Any, files: Files) -> None:
    """Warn about public names that no page documents. All pages have been rendered by now."""
    for name in modp_ti.__all__:
        if name not in documented and name != "__version__":
            log.warning("modp_ti.%s is public, but no page of docs/reference has an entry `::: modp_ti.%s`", name, name)


def _with_program(link: re.Match[str], folder: Path) -> str:
    code = (folder / link[1]).read_text(encoding="utf-8")
    return f"{link[0]}\n\n```python\n{code}```"


def _resolved(entry: re.Match[str]) -> str:
    documented.add(entry[1])
    public = getattr(modp_ti, entry[1])
    return f"::: {public.__module__}.{public.__qualname__}"
