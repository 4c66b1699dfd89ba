"""The cache of compiled functions on disk: damaged files are replaced, changed ones noticed."""

import gc
import os
import shutil
import subprocess
import sys

import pytest
from paths import LIBRARY, ROOT

from roboarm_nmp.utils.numba_cache import compiled
from roboarm_nmp.viewer import compile as compile_command

MODULE = """
from roboarm_nmp.utils.numba_cache import compiled

@compiled
def double(x):
    return 2 * x

@compiled
def quadruple(x):
    return double(double(x))

print(quadruple(3.0), quadruple(3))
"""
INNER = """
from roboarm_nmp.utils.numba_cache import compiled

FACTOR = 2.0

@compiled
def scale(x):
    return FACTOR * x
"""
OUTER = """
from roboarm_nmp.envs.inner_kernels import FACTOR, scale
from roboarm_nmp.utils.numba_cache import compiled

@compiled
def outer(x):
    return scale(x) + FACTOR

print(outer(3.0))
"""


def begin(module, folder, **variables):
    """A process that imports a module of a folder, with what the package has in that folder."""
    env = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    return subprocess.Popen(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, '.'); import {module}"],
        cwd=folder,
        env=env | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(module, folder, cache):
    """What a module prints, and the lines on stderr that name a file of the cache."""
    process = begin(module, folder, NUMBA_CACHE_DIR=str(cache))
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    return output, [line for line in errors.splitlines() if str(cache) in line]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with three modules, and a package that has little else than `utils`."""
    folder = tmp_path_factory.mktemp("modules")
    shutil.copytree(LIBRARY / "utils", folder / "roboarm_nmp" / "utils")
    (folder / "roboarm_nmp" / "__init__.py").touch()
    (folder / "envs").mkdir()
    (folder / "roboarm_nmp" / "envs").symlink_to("../envs")  # as in a checkout
    (folder / "envs" / "inner_kernels.py").write_text(INNER)
    (folder / "outer_kernels.py").write_text(OUTER)
    (folder / "small.py").write_text(MODULE)
    return folder


@pytest.fixture(scope="module")
def compiled_once(folder):
    assert run("small", folder, folder / "cache") == ("12.0 12\n", [])
    return folder / "cache"


@pytest.fixture
def cache(compiled_once, tmp_path):
    """A copy of a cache with the functions of `small`, to be damaged."""
    return shutil.copytree(compiled_once, tmp_path / "cache")


def flip_a_bit(content):
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


def test_damaged_file_is_named_ignored_and_replaced(folder, cache):
    path = min(cache.rglob("*quadruple*.nbc"))
    path.write_bytes(flip_a_bit(path.read_bytes()))
    result, lines = run("small", folder, cache)
    assert result == "12.0 12\n"
    assert len(lines) == 1 and lines[0].startswith(f"{path}: damaged")
    assert run("small", folder, cache) == ("12.0 12\n", [])


def test_cache_is_in_the_user_folder_and_the_first_compilation_is_announced_once(folder, tmp_path):
    variables = {"ROBOARM_NMP_CACHE": str(tmp_path)}
    at_once = [begin("small", folder, **variables) for _ in range(2)]
    outputs = [process.communicate() for process in at_once]
    assert [process.returncode for process in at_once] == [0, 0], outputs
    lines = "".join(error for _, error in outputs).splitlines()
    assert lines == ["compiling once, about half a minute (roboarm compile: for all commands)"]
    assert begin("small", folder, **variables).communicate() == ("12.0 12\n", "")
    assert list(tmp_path.glob("numba/*/small.quadruple*.nbc"))


def test_compilation_without_any_cache_folder_works(folder, tmp_path):
    (tmp_path / "file").touch()
    process = begin("small", folder, ROBOARM_NMP_CACHE=str(tmp_path / "file"))
    assert process.communicate()[0] == "12.0 12\n"


def test_function_is_compiled_again_when_what_it_uses_changes_in_another_file(folder, tmp_path):
    assert run("outer_kernels", folder, tmp_path) == ("8.0\n", [])
    entry = min(tmp_path.rglob("*outer_kernels.outer*.nbc"))
    compiled_at = entry.stat().st_mtime_ns
    assert run("outer_kernels", folder, tmp_path) == ("8.0\n", [])
    assert entry.stat().st_mtime_ns == compiled_at
    (folder / "envs" / "inner_kernels.py").write_text(INNER.replace("2.0", "3.0"))
    assert run("outer_kernels", folder, tmp_path) == ("12.0\n", [])


def test_compiled_functions_are_in_files_that_the_cache_watches():
    for path in ROOT.rglob("*.py"):
        if not path.is_relative_to(ROOT / "tests") and "import compiled" in path.read_text():
            assert path.name.endswith("kernels.py"), path


def test_compile_has_something_to_do_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ROBOARM_NMP_CACHE", str(tmp_path))
    calls = []
    monkeypatch.setattr(compile_command, "PARTS", {"plan": lambda: calls.append("plan")})
    compile_command.main(compile_command.Args())
    assert "compiled in" in capsys.readouterr().out
    compile_command.main(compile_command.Args())
    assert "compiled before" in capsys.readouterr().out and calls == ["plan"]
    compile_command.main(compile_command.Args(force=True))
    assert calls == ["plan", "plan"]


@compiled
def _sum(a, b=1):
    return a + b


@compiled
def _sums(a):
    return _sum(a, 0) + _sum(3, a) + _sum(a) + _sum(a, b=0.5)


def test_called_functions_are_part_of_their_callers_and_can_be_called():
    assert _sums(2) == 12.5 and not _sum.signatures
    assert _sum(2) == 3 and _sum(2, b=0.5) == 2.5
    assert gc.isenabled()  # it rests during compilations
