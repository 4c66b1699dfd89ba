"""YAML documents: one in a file, which may end with `---`."""

import pytest

from roboarm_nmp.utils.documents import Mistake, parse_document


@pytest.mark.parametrize("end", ["", "---\n", "...\n", "--- \n# the end\n"])
def test_document_may_end_with_a_separator(end):
    assert parse_document(f"a: 1\n{end}").value["a"].value == "1"


def test_second_document_is_rejected():
    with pytest.raises(Mistake, match="a second document begins"):
        parse_document("a: 1\n---\nb: 2\n")
