"""Numba's cache on disk: damaged files are named, ignored and replaced."""

import os
import shutil
import subprocess
import sys

import pytest
from paths import LIBRARY, ROOT

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
CHECKER = """
import numpy as np
from roboarm_nmp import envs
from roboarm_nmp.envs.collision.checker import CollisionChecker

states = np.random.default_rng(0).uniform(-1, 1, (1000, 7))
print(CollisionChecker(envs.get_task("wall").scene).is_free(states).sum())
"""


def run(code, cwd, cache):
    """The last line of stdout, and the lines on stderr that name a file of the cache."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=cwd,
        capture_output=True,
        text=True,
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
    )
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stderr.splitlines() if str(cache) in line]
    return done.stdout.splitlines()[-1], lines


@pytest.fixture(scope="module")
def compiled_once(tmp_path_factory):
    """A folder with the module `small`, whose functions are in the cache."""
    folder = tmp_path_factory.mktemp("compiled_once")
    (folder / "small.py").write_text(MODULE)
    assert run("import small", folder, folder / "cache") == ("12.0 12", [])
    return folder


@pytest.fixture
def cache(compiled_once, tmp_path):
    """A copy of that cache, to be damaged."""
    return shutil.copytree(compiled_once / "cache", tmp_path / "cache")


def flip_a_bit(content):
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


DAMAGES = {
    "empty": lambda content: b"",
    "truncated": lambda content: content[: len(content) // 2],
    "another kind of file": lambda content: b"\x89HDF\r\n\x1a\n" + bytes(1000),
    "one bit flipped": flip_a_bit,
}


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [(".nbc", damage) for damage in DAMAGES]
    # (An index with a wrong bit may just lack its entry, which is no error.)
    + [(".nbi", damage) for damage in DAMAGES if damage != "one bit flipped"],
)
def test_damaged_file_is_named_ignored_and_replaced(compiled_once, cache, suffix, damage):
    path = min(cache.rglob(f"*quadruple*{suffix}"))
    path.write_bytes(DAMAGES[damage](path.read_bytes()))
    result, lines = run("import small", compiled_once, cache)
    assert result == "12.0 12"
    assert len(lines) == 1 and lines[0].startswith(f"{path}: damaged")
    assert run("import small", compiled_once, cache) == ("12.0 12", [])


def test_cache_with_all_files_damaged_is_replaced(compiled_once, cache):
    for path in cache.rglob("*.nb?"):
        path.write_bytes(b"")
    assert run("import small", compiled_once, cache)[0] == "12.0 12"
    assert run("import small", compiled_once, cache) == ("12.0 12", [])


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_folder_in_the_place_of_a_file_is_named_and_ignored(compiled_once, cache, suffix):
    path = min(cache.rglob(f"*quadruple*{suffix}"))
    path.unlink()
    path.mkdir()
    result, lines = run("import small", compiled_once, cache)
    assert result == "12.0 12" and any(path.name in line for line in lines)


def begin(folder, **variables):
    """A process that imports the module `small` of a folder."""
    env = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    return subprocess.Popen(
        [sys.executable, "-c", "import small"],
        cwd=folder,
        env=env | variables,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_cache_is_in_the_user_folder_and_the_first_compilation_is_announced_once(tmp_path):
    (tmp_path / "small.py").write_text(MODULE)
    cache = tmp_path / "cache"
    variables = {"ROBOARM_NMP_CACHE": str(cache)}
    at_once = [begin(tmp_path, **variables) for _ in range(2)]
    outputs = [process.communicate() for process in at_once]
    assert [process.returncode for process in at_once] == [0, 0], outputs
    said = "".join(error for _, error in outputs).splitlines()
    assert said == ["compiling collision checks and kinematics (once, about 30 s)"]
    assert begin(tmp_path, **variables).communicate() == ("12.0 12\n", "")
    assert list(cache.glob("numba/*/small.quadruple*.nbc"))
    assert not [path for path in tmp_path.rglob("*.nb?") if cache not in path.parents]


def test_compilation_without_any_cache_folder_works(tmp_path):
    (tmp_path / "small.py").write_text(MODULE)
    (tmp_path / "file").write_bytes(b"")
    output, _ = begin(tmp_path, ROBOARM_NMP_CACHE=str(tmp_path / "file")).communicate()
    assert output == "12.0 12\n"


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


def test_function_is_compiled_again_when_one_that_it_calls_changes_in_another_file(tmp_path):
    package, cache = tmp_path / "roboarm_nmp", tmp_path / "cache"
    (tmp_path / "envs").mkdir()  # a link in the package, as in a checkout
    shutil.copytree(LIBRARY / "utils", package / "utils")
    (package / "__init__.py").touch()
    (package / "envs").symlink_to("../envs")
    (tmp_path / "envs" / "inner_kernels.py").write_text(INNER)
    (tmp_path / "outer_kernels.py").write_text(OUTER)
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import outer_kernels"
    assert run(code, tmp_path, cache) == ("8.0", [])
    entry = min(cache.rglob("*outer_kernels.outer*.nbc"))
    compiled_at = entry.stat().st_mtime_ns
    assert run(code, tmp_path, cache) == ("8.0", [])
    assert entry.stat().st_mtime_ns == compiled_at
    (tmp_path / "envs" / "inner_kernels.py").write_text(INNER.replace("2.0", "3.0"))
    assert run(code, tmp_path, cache) == ("12.0", [])


def test_compiled_functions_are_in_files_that_the_cache_watches():
    for path in ROOT.rglob("*.py"):
        if path.is_relative_to(ROOT / "tests") or "import compiled" not in path.read_text():
            continue
        assert path.name.endswith("kernels.py"), path


def test_collision_checks_survive_a_damaged_cache(tmp_path):
    first = run(CHECKER, ROOT, tmp_path)
    assert 0 < int(first[0]) < 1000 and first[1] == []
    for pattern in ("*free_batch*.nbi", "*.is_free*.nbc"):
        for path in tmp_path.rglob(pattern):
            path.write_bytes(path.read_bytes()[:50])
    result, lines = run(CHECKER, ROOT, tmp_path)
    assert result == first[0] and len(lines) == 2
    assert run(CHECKER, ROOT, tmp_path) == first
