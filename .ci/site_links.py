"""Check the links within a built site: every page, picture and anchor that a page of FOLDER refers to must be there.

    python .ci/site_links.py FOLDER

Links to other sites are not followed. Ends with status 1 after a line for each link that leads nowhere.
"""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class Page(HTMLParser):
    """Anchors of a page, and what it refers to."""

    def __init__(self, path: Path) -> None:
        """Read the page `path`."""
        super().__init__()
        self.anchors: set[str] = {"", "top"}
        self.links: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take the attributes of a tag that name an anchor or a link."""
        for name, value in attrs:
            if name == "id" or (tag == "a" and name == "name"):
                self.anchors.add(value or "")
            elif name in ("href", "src") and value:
                self.links.append(value)


def broken(folder: Path) -> list[str]:
    """Return a line for each link of the site in `folder` that leads nowhere."""
    pages = {path.resolve(): Page(path) for path in sorted(folder.rglob("*.html"))}
    lines = []
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            anchored = target not in pages or unquote(parts.fragment) in pages[target].anchors
            if not (target.is_file() and anchored):
                lines.append(f"{path.relative_to(folder.resolve())}: {link}")
    return lines


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    lines = broken(folder)
    print(*lines, sep="\n", end="\n" if lines else "")
    sys.exit(1 if lines or not any(folder.rglob("*.html")) else 0)
