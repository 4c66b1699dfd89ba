"""docs/reference/command_line.md is what docs/make_command_line.py writes."""

from docs_scripts import load


def test_command_line_page_is_up_to_date():
    script = load("make_command_line")
    assert script.PAGE.read_text() == script.page(), "run python docs/make_command_line.py"
