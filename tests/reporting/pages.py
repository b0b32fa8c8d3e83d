"""A page as its tests read it."""

from __future__ import annotations

import re
from html.parser import HTMLParser

from sealscope.reporting.picture import Picture

VOID = {"meta", "link", "br", "img", "hr", "input"}


class Reader(HTMLParser):
    """Reads a page, insists on balanced tags, and collects what the tests ask for."""

    def __init__(self, page):
        super().__init__(convert_charrefs=True)
        self.open, self.targets, self.values, self.scripts, self.handlers, self.ids = [], [], {}, [], [], []
        self.text, self.tables = "", []
        self.feed(page)
        self.close()
        assert self.open == [], f"left open: {self.open}"

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        named = dict(attrs)
        assert len(named) == len(attrs), f"an attribute of <{tag}> stands twice"
        self.targets += [named[name] for name in ("src", "href", "action", "data", "xlink:href") if named.get(name)]
        self.handlers += [name for name in named if name.startswith("on")]
        if "id" in named:
            self.ids.append(named["id"])
        if tag == "data":
            self.values.setdefault(named["value"], "")
            self.current = named["value"]
        if tag == "script":
            self.scripts.append("")
        if tag == "table":
            self.tables.append(False)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-1:]}"
        self.open.pop()

    def handle_data(self, data):
        if self.open[-1:] == ["script"]:
            self.scripts[-1] += data
        elif self.open[-1:] != ["style"]:
            self.text += data
        if "data" in self.open:
            self.values[self.current] += data
        if self.open[-1:] == ["caption"] and data.strip():
            self.tables[-1] = True


def places(picture: Picture, style: str) -> list[tuple[float, float]]:
    """Where the shapes of a style stand in a picture, in values of its axes: each `M` and the end of each upright."""
    (start, stop), (low, high) = picture.x_ends, picture.y_ends
    found = []
    for shape in picture.shapes:
        if shape.style == style:
            for x, y, end in re.findall(r"[ML](-?[\d.]+) (-?[\d.]+)(?:V(-?[\d.]+))?", shape.path):
                day = start + float(x) / picture.width * (stop - start)
                found += [(day, high - float(at) / picture.height * (high - low)) for at in (y, end) if at]
    return found
