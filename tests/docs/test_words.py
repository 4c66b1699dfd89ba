"""Pages use the field's words: none of the project's earlier names for the same concepts."""

import re

import pytest
from paths import ROOT

FOLDERS = ("guide", "algorithms", "customise", "reference")
PAGES = [
    ROOT / "docs" / f"{name}.md" for name in ("index", "install", "quickstart", "lab_notebook")
]
PAGES += [page for name in FOLDERS for page in sorted((ROOT / "docs" / name).glob("*.md"))]
# What they are now: safety filter, margin, escape, local minimum, link distances, decoded, geometry
# source, latent code, collision-free, contact, pretrained, image, repair, overfit, objects.
OLD = (
    r"last layer|own layer|keep.distance|way out|dead end|detour|proximity|\btold\b|\btells?\b"
    r"|\bknows?\b|64 numbers|obstacles themselves|true obstacles|clean success|\btouch(?!_links)"
    r"|look,? then plan|\bcaution|\bshipped|\bpackaged|\bpicture|\bmend\b|by heart|\bthings?\b"
    r"|\bwhat does not learn|\bsome\b|\belse\b"
)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_page_has_no_old_words(page):
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.S | re.M)
    assert re.findall(OLD, text, re.IGNORECASE) == []
