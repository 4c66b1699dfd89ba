"""README and the docs: tables equal their data, links lead somewhere, the site names all pages."""

import re
import unicodedata

import markdown_tables
import pytest
import render_tables
from paths import ROOT

PAGES = markdown_tables.pages()
DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def tables():
    return render_tables.all_tables()


def page_id(page):
    return str(page.relative_to(ROOT))


def prose(page):
    """A page without its code: fenced blocks and `code`."""
    text = re.sub(r"^ *(```|~~~).*?^ *\1 *$", "", page.read_text(), flags=re.S | re.M)
    return re.sub(r"`[^`\n]*`", "code", text)


def anchors(page):
    """Those of a page's headings, on a code-hosting site and in the built site alike."""
    text = re.sub(r"^ *(```|~~~).*?^ *\1 *$", "", page.read_text(), flags=re.S | re.M)
    found = set()
    for heading in re.findall(r"^#+ +(.*?) *#*$", text, re.M):
        heading = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
        plain = unicodedata.normalize("NFKD", heading).encode("ascii", "ignore").decode()
        in_site = re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower())
        hosted = re.sub(r"[^\w\s-]", "", heading).strip().lower().replace(" ", "-")
        if in_site == hosted:
            found.add(in_site)
    return found | set(re.findall(r'(?:id|name)="([^"]+)"', text))


def links(page):
    """Targets of Markdown and HTML links and images."""
    text = prose(page)
    found = re.findall(r"\]\(\s*<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\s*\)", text)
    found += re.findall(r"^\[[^\]]+\]: +(\S+)$", text, re.M)
    return found + re.findall(r'(?:src|href)="([^"]+)"', text)


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_tables_equal_their_data(page, tables):
    text = page.read_text()
    assert markdown_tables.render(text, tables) == text, "python benchmarks/render_tables.py"
    names = re.findall(r"<!-- end of (\S+) -->", text)
    assert [mark["name"] for mark in markdown_tables.MARKS.finditer(text)] == names
    assert set(names) <= set(tables)


def test_every_table_stands_in_a_page(tables):
    text = "\n".join(page.read_text() for page in PAGES)
    assert [name for name in tables if f"<!-- end of {name} -->" not in text] == []


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_links_and_anchors_exist(page):
    broken = []
    for link in links(page):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        # The site contains nothing but the docs.
        is_there = target.exists() and (page.parent == ROOT or target.is_relative_to(DOCS))
        if not is_there or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert not broken


def test_site_lists_every_page():
    text = (ROOT / "mkdocs.yml").read_text()
    listed = re.findall(r"^ +- (\S+\.md)$", text, re.M)
    outside = re.findall(r"^  /(\S+\.md)$", text, re.M)
    there = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    assert sorted(listed + outside) == sorted(there)
