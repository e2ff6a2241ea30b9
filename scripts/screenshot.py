"""Take a screenshot of the viewer's page: `scripts/screenshot URL FILE.png`."""

from __future__ import annotations

import argparse

from browser import choose_mode, missing, open_page
from ending import documented_ending

from modp_ti.files.errors import InputError


@documented_ending()
def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url", help="what `modp-ti run --view` or `modp-ti view` printed")
    parser.add_argument("file", help="PNG to write")
    parser.add_argument("--mode", default="splats", help="what the page shows")
    parser.add_argument("--wait", type=float, default=15.0, help="seconds for the page to show it")
    parser.add_argument("--until", help="text in the page that is waited for first, two minutes long: `frame 30`")
    arguments = parser.parse_args()
    lacking = missing()
    if lacking:
        raise InputError(lacking)
    with open_page(arguments.url) as page:
        if arguments.until:
            page.get_by_text(arguments.until).first.wait_for()
        if arguments.mode != "splats":
            choose_mode(page, arguments.mode)
        page.wait_for_timeout(1000 * arguments.wait)
        page.screenshot(path=arguments.file)


if __name__ == "__main__":
    main()
