"""The page: one file that holds the map and loads nothing."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from modp_ti.outputs.formats.sog import sog_bytes
from modp_ti.outputs.splat_page.page import write_splat_page
from tests.modp_ti.outputs.formats.test_splats import clustered

NAME = "</title><script>alert('x')</script> & more"
ALPHABET = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz!#$%&()*+-;,=>?@^_`{|}~"


class Elements(HTMLParser):
    """The page's elements by id or name, and its attributes."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.at = ""
        self.texts: dict[str, str] = {}
        self.attributes: list[tuple[str, str, str]] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.at = dict(attrs).get("id") or tag
        self.attributes += [(tag, key, value or "") for key, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        self.at = ""

    def handle_data(self, data: str) -> None:
        self.texts[self.at] = self.texts.get(self.at, "") + data


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, Path, Elements]:
    state = clustered(4000, degree=1)
    file = tmp_path_factory.mktemp("page") / "map.html"
    write_splat_page(file, NAME, state, {"note": "</script>"})
    return state, file, Elements(file.read_text("utf-8"))


def test_the_page_holds_the_map_and_the_settings(written: tuple[dict, Path, Elements]) -> None:
    state, _, elements = written
    text, content = elements.texts["map"], bytearray()
    for i in range(0, len(text), 5):
        word = 0
        for character in text[i : i + 5]:
            word = 85 * word + ALPHABET.index(character)
        content += word.to_bytes(4, "big")
    sog = sog_bytes(state)
    assert content[: len(sog)] == sog and not any(content[len(sog) :])
    assert f'decoded(text("map"), {len(sog)})' in elements.texts["script"]
    assert f'alphabet = "{ALPHABET}"' in elements.texts["script"]
    assert json.loads(elements.texts["settings"]) == {"note": "</script>"}
    assert elements.texts["title"].strip() == NAME


def test_the_page_may_load_nothing(written: tuple[dict, Path, Elements]) -> None:
    _, _, elements = written
    for tag, key, value in elements.attributes:
        assert key not in ("src", "srcset", "action") and (key != "href" or value == "data:,"), (tag, key, value)
    policy = next(v for _, key, v in elements.attributes if key == "content" and v.startswith("default-src"))
    assert policy.startswith("default-src 'none';")
    assert not re.search(r"https?:|\*|'self'", policy)


def test_the_page_carries_the_licence_and_the_version_of_the_viewer(written: tuple[dict, Path, Elements]) -> None:
    _, file, elements = written
    for part in ("style", "script"):
        assert re.search(
            r"SuperSplat Viewer \d+\.\d+\.\d+ \(npm: @playcanvas/supersplat-viewer\)", elements.texts[part]
        )
        assert "Permission is hereby granted, free of charge" in elements.texts[part]
    assert file.stat().st_size < 2_200_000 + 20 * 4000
