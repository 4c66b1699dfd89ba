"""The scripts in docs as modules, for the tests, and the code of pages."""

import importlib.util
import re
from types import ModuleType

from paths import ROOT


def load(name: str) -> ModuleType:
    """The script `docs/NAME.py` as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def code_of(page: str, language: str = "python") -> list[str]:
    """The fenced blocks in a language of a page, `guide/tasks.md`."""
    text = (ROOT / "docs" / page).read_text()
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.S | re.M)


def names_of(page: str) -> dict:
    """The names that the Python blocks of a page define, run from top to bottom."""
    names = {}
    for number, block in enumerate(code_of(page)):
        exec(compile(block, f"{page}, block {number}", "exec"), names)
    return names
