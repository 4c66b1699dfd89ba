"""docs/reference/command_line.md is what docs/make_command_line.py writes."""

import importlib.util

from paths import ROOT


def make_page():
    """The module docs/make_command_line.py."""
    path = ROOT / "docs" / "make_command_line.py"
    spec = importlib.util.spec_from_file_location("make_command_line", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_command_line_page_is_up_to_date():
    script = make_page()
    assert script.PAGE.read_text() == script.page(), "run python docs/make_command_line.py"


def test_table_shows_defaults_choices_and_positional_arguments():
    text = make_page().page()
    assert "| `--num-modes` | `1` | Gaussians of the policy's mixture;" in text
    assert "| `--goal-type` | `combined` | `config`, `combined`, `pose`: what the goal is:" in text
    assert "| `--stop-on-collision` | `no` | end an episode at the first contact |" in text
    assert "| `TASK` |  | The task's name" in text
