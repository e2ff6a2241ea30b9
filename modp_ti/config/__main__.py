"""`python -m modp_ti.config` prints the reference of every key and of the presets as Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from modp_ti.config.keys import KeyDoc, as_yaml, documented_keys
from modp_ti.config.presets import PRESETS
from modp_ti.config.settings import SceneConfig

INTRODUCTION = """\
# Settings

This page lists every key of `scene.yaml`. Only `tracker.kind` and `output` are required, and `source.path`
for most trackers. Relative paths are relative to the scene file. An unknown key is an error that names the
nearest right one. Units are in square brackets. To override a key on the command line, use `--set`, whose paths are
relative to the folder where the command is typed; `--fast` and `--best` set several at once ([Presets](#presets)):

```sh
modp-ti run scene.yaml --set source.scale=0.5 --set refine.steps=3000
modp-ti run scene.yaml --fast
```

The tables are generated: `python -m modp_ti.config > docs/configuration.md`."""

PRESETS_INTRODUCTION = """\
## Presets

`modp-ti run` has options that set several keys at once. A key in the scene file or with `--set` wins over the preset.
The `config.yaml` of a run holds every key, so a preset changes nothing there."""


def reference() -> str:
    """Format the reference of all keys as Markdown: a table for each section, and one of the presets."""
    sections: dict[str, list[KeyDoc]] = {}
    for entry in documented_keys(SceneConfig):
        sections.setdefault(entry.key.rpartition(".")[0], []).append(entry)
    lines = [INTRODUCTION]
    for section, entries in sections.items():
        lines += ["", f"## {f'`{section}`' if section else 'Top level'}", ""]
        kinds = [entry for entry in entries if entry.selects]
        if kinds:
            lines += [f"`{kinds[0].key}` is required, and the other keys depend on it:", ""]
            lines += _table([kinds[0].key, "meaning"], ([f"`{kind.variant}`", kind.description] for kind in kinds))
            lines += [""]
        lines += _table(["key", *(["kinds"] if kinds else []), "type", "default", "meaning"], _rows(entries))
    return "\n".join([*lines, "", *_presets()]) + "\n"


def _rows(entries: Sequence[KeyDoc]) -> Iterator[list[str]]:
    """The rows of a section. A key with the same meaning for several kinds is one row that names them."""
    kinds: dict[tuple[str, ...], list[str]] = {}
    for entry in entries:
        if not entry.selects:
            default = "required" if entry.default is None else f"`{entry.default}`" if entry.default else "empty"
            row = (f"`{entry.key}`", entry.type, default, entry.description)
            kinds.setdefault(row, []).append(f"`{entry.variant}`" if entry.variant else "")
    for (key, *rest), names in kinds.items():
        yield [key, *([", ".join(names)] if any(names) else []), *rest]


def _presets() -> Iterator[str]:
    """One row per key, one column per preset. A preset that does not set the key keeps its default."""
    yield from [PRESETS_INTRODUCTION, "", *(f"- `--{name}`: {preset.purpose}." for name, preset in PRESETS.items()), ""]
    columns = [{entry.key: entry.default for entry in documented_keys(SceneConfig)}]
    columns += [{key: as_yaml(value) for key, value in preset.settings.items()} for preset in PRESETS.values()]
    keys = dict.fromkeys(key for preset in PRESETS.values() for key in preset.settings)
    rows = ([f"`{key}`", *(f"`{column.get(key, columns[0][key])}`" for column in columns)] for key in keys)
    yield from _table(["key", "default", *(f"`--{name}`" for name in PRESETS)], rows)


def _table(head: Sequence[str], rows: Iterator[list[str]]) -> list[str]:
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    return lines + ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]


if __name__ == "__main__":
    print(reference(), end="")
