"""The documentation's links: every page and heading that a page or a source names is there."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [path for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")) if "generated" not in path.parts]
CHECKER = ROOT / ".ci" / "site_links.py"


def prose(path: Path) -> str:
    """The text of a page without its blocks of code."""
    return re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def anchors(path: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and the site make them: lower case, blanks to hyphens, no punctuation."""
    headings = re.findall(r"^#+ (.*)$", prose(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(path):
    nowhere = []
    for link in re.findall(r"\]\(([^)\s]+)\)", prose(path)):
        if re.match(r"[a-z]+:", link) or "generated/" in link:
            continue
        place, _, heading = unquote(link).partition("#")
        target = (path.parent / place).resolve() if place else path
        if not target.exists() or (heading and target.suffix == ".md" and heading not in anchors(target)):
            nowhere.append(link)
    assert nowhere == []


def test_pages_that_sources_and_pages_name_exist():
    files = [path for folder in ("src", "tests", "benchmarks", ".ci") for path in (ROOT / folder).rglob("*.py")]
    files += [*(ROOT / "src").rglob("*.toml"), *PAGES]
    named = {
        (name, path.relative_to(ROOT).as_posix())
        for path in files
        for name in re.findall(r"\bdocs/[\w/-]+\.(?:md|json|py)", path.read_text(encoding="utf-8"))
    }
    assert len(named) > 20
    assert sorted(pair for pair in named if not (ROOT / pair[0]).exists()) == []


def test_a_site_with_a_broken_link_is_refused(tmp_path):
    (tmp_path / "a.html").write_text('<h1 id="top-of-a">A</h1><a href="b.html#here">b</a><a href="#top-of-a">up</a>')
    (tmp_path / "b.html").write_text('<p id="here">B</p><img src="c.png"><a href="https://example.org/none">far</a>')
    (tmp_path / "c.png").touch()

    def check() -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, CHECKER, tmp_path], capture_output=True, text=True, check=False)

    assert (check().returncode, check().stdout) == (0, "")
    (tmp_path / "b.html").write_text('<p id="there">B</p><img src="d.png">')
    assert (check().returncode, check().stdout.splitlines()) == (1, ["a.html: b.html#here", "b.html: d.png"])


def cells(path: Path) -> list[tuple[str, str]]:
    """The cells of a tutorial: their tags, and what is run."""
    blocks = re.findall(
        r"^```\{code-cell\} python\n(.*?)^```", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    split = [re.match(r"((?::[^\n]*\n)*)\n?(.*)", block, re.DOTALL) for block in blocks]
    return [(match[1], match[2]) for match in split]


TUTORIALS = [*sorted((ROOT / "docs" / "tutorials").glob("*.md")), ROOT / "docs" / "gallery.md"]


@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_shows_all_that_it_needs(path):
    """It says what to install, shows its cells, and removes only what keeps the site's build in a folder of its own."""
    text = path.read_text(encoding="utf-8")
    needed = re.search(r"\*You need: Sealscope(?: with the extra `(\w+)`)? \(\[install\]\(", text)
    assert needed
    run = "".join(cell for _, cell in cells(path))
    assert (needed[1] == "report") == ("matplotlib" in run)
    assert (needed[1] == "serve") == ("sealscope monitor" in run)
    for tags, cell in cells(path):
        assert "hide" not in tags
        if "remove-cell" in tags:
            assert "os.chdir(" in cell or cell.startswith("# stands for `pip install .`")
            assert "sealscope as ss" not in cell


def test_the_changelog_has_the_version_of_the_package():
    version = re.search(r'^version = "([\d.]+)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)[1]
    newest = re.search(r"^## ([\d.]+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)[1]
    cited = re.search(r"^version: ([\d.]+)", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)[1]
    assert newest == version == cited


GUIDE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_files_that_the_guide_names_exist():
    """A file that stands beside another one is named without the beginning of its path."""
    named = {name for name in re.findall(r"`([\w/.-]+\.(?:py|toml|md))`", GUIDE) if "NAME" not in name}
    paths = [f"/{path.relative_to(ROOT).as_posix()}" for path in ROOT.rglob("*.*") if ".git" not in path.parts]
    assert len(named) > 25
    assert sorted(name for name in named if not any(path.endswith(f"/{name}") for path in paths)) == []


def test_symbols_that_the_guide_names_are_in_their_files():
    pairs = re.findall(r"`([\w/]+/\w+\.py)`: `(\w[\w.]*)`", GUIDE)
    source = ROOT / "src" / "sealscope"
    files = {name: path.read_text(encoding="utf-8") for name, _ in pairs if (path := source / name).exists()}
    words = [(name, word) for name, symbol in pairs for word in symbol.split(".") if name in files]
    assert len(words) >= 7
    assert [(name, word) for name, word in words if not re.search(rf"\b{word}\b", files[name])] == []


def test_keys_that_the_guide_names_have_value_unit_and_source():
    """After a file of priors stand keys in the form `[table] key`, and further keys of the same table alone."""
    cells = re.findall(r"`([\w/]+/priors\.toml)` ((?:(?:, )?`\[\w+\] \w+`|, `\w+`)+)", GUIDE)
    keys, table = [], ""
    for name, text in cells:
        tables = tomllib.loads((ROOT / "src" / "sealscope" / name).read_text(encoding="utf-8"))
        for heading, key in re.findall(r"`(?:\[(\w+)\] )?(\w+)`", text):
            table = heading or table
            keys.append((name, table, key, set(tables.get(table, {}).get(key, ()))))
    assert len(keys) >= 4
    assert [key for key in keys if key[-1] != {"value", "unit", "source"}] == []
