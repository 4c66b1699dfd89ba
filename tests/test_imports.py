"""Imports between modules point one way: no circle, no upward import, none hidden from a reader."""

import ast
import functools
import graphlib
import re

from paths import LIBRARY, ROOT

from roboarm_nmp.__main__ import TRAINERS

PACKAGE = "roboarm_nmp"
# From the bottom to the top. A module may import from its own package and from the rows before it.
ROWS = [
    ("utils",),
    ("networks",),
    ("envs",),
    ("datasets", "planning"),
    ("policies", "motions"),
    ("evaluation",),
    ("__init__",),  # make, evaluate
    ("training", "viewer", "demo_generation"),
    ("clean_rl_scripts", "bc_script", "scene_embedding_train"),
    ("benchmarks", "__main__"),
]
# The environment's own files and packages, likewise.
ENV_ROWS = [
    ("robots",),
    ("scenes", "subgoals", "goals", "point_images"),
    ("world", "collision", "tasks"),
    ("arm_env", "perception"),
    ("wrappers", "following"),
    ("__init__",),  # `make`
]
MOST_ROOMS, MOST_FLOORS, MOST_PAIRS = 17, 9, 75


def modules():
    """The names of all modules, without `roboarm_nmp.`, and their files."""
    files = [*LIBRARY.glob("*.py"), *(ROOT / "benchmarks").glob("*.py")]
    for folder in LIBRARY.iterdir():
        if folder.is_dir():
            files += folder.resolve().rglob("*.py")
    names = {}
    for path in files:
        base = LIBRARY if LIBRARY in path.parents else ROOT
        parts = path.relative_to(base).with_suffix("").parts
        names[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return names


def imports(path, known):
    """The names of the project's modules that a file imports, in functions too."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    modules = set()
    for name in names:
        top, _, name = name.partition(".")
        if top == PACKAGE:  # the longest part of the name that is a module
            while name and name not in known:
                name = name.rpartition(".")[0]
            modules.add(name)
    return modules


@functools.cache
def graph():
    """Of every module, which of the others it imports. The package itself is "" here."""
    known = modules()
    return {name: imports(path, known) for name, path in known.items()}


def room(module):
    """The package that a module is in, or its own name at the top."""
    return module.partition(".")[0] or "__init__"


def env_room(module):
    """Of a module in `envs`, the package or file there."""
    return (module.split(".") + ["__init__"])[1]


def arrows(graph, place):
    """Pairs of places between which there are imports, and an example of each."""
    pairs = {}
    for module, others in graph.items():
        for other in others:
            if place(module) != place(other):
                pairs.setdefault((place(module), place(other)), f"{module} -> {other}")
    return pairs


def floors(pairs):
    """The number of places in the longest chain of imports; raises CycleError on a circle."""
    below = {}
    for upper, lower in pairs:
        below.setdefault(upper, set()).add(lower)
    height = {}
    for name in graphlib.TopologicalSorter(below).static_order():
        height[name] = 1 + max((height[lower] for lower in below.get(name, ())), default=0)
    return max(height.values())


def upward(pairs, rows):
    """The examples of pairs that point up, or sideways within a row."""
    row_of = {name: row for row, names in enumerate(rows) for name in names}
    return [example for (upper, lower), example in pairs.items() if row_of[lower] >= row_of[upper]]


def test_files_import_each_other_without_a_circle():
    graphlib.TopologicalSorter(graph()).prepare()  # raises CycleError on a circle


def test_house_is_small_and_no_arrow_points_up(capsys):
    pairs = arrows(graph(), room)
    rooms = {room(module) for module in graph()}
    with capsys.disabled():
        print(f"\n{len(rooms)} packages and files, {floors(pairs)} floors, {len(pairs)} pairs")
    assert not upward(pairs, ROWS)
    assert len(rooms) <= MOST_ROOMS
    assert floors(pairs) <= MOST_FLOORS
    assert len(pairs) <= MOST_PAIRS


def test_no_arrow_within_the_environment_points_up():
    inside = {
        module: {other for other in others if room(other) == "envs"}
        for module, others in graph().items()
        if room(module) == "envs"
    }
    assert not upward(arrows(inside, env_room), ENV_ROWS)


def test_trainers_do_not_import_each_other():
    trainers = {module for module, _ in TRAINERS.values()}
    assert trainers <= graph().keys()
    between = {name: graph()[name] & trainers for name in trainers}
    assert not any(between.values()), between


def test_no_module_hides_an_import():
    """`import_module("roboarm_nmp…")` is seen neither by an editor nor by these tests."""
    for path in modules().values():
        text = path.read_text()
        for node in ast.walk(ast.parse(text)) if "import_" in text else ():
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(
                ("import_module", "__import__")
            ):
                loaded = node.args[0]
                is_other = isinstance(loaded, ast.Constant) and not loaded.value.startswith(PACKAGE)
                assert is_other, f"{path}:{node.lineno}: {ast.unparse(node)}"


def test_no_module_is_imported_by_an_ambiguous_name():
    """`import envs` would find whichever folder of that name comes first."""
    folders = {path.name for path in LIBRARY.iterdir() if path.is_symlink()}
    assert len(folders) == 5
    ambiguous = re.compile(rf"^ *(import|from) ({'|'.join(folders)})\b", re.MULTILINE)
    for path in ROOT.rglob("*.py"):
        if any(part.startswith(".") or part == "build" for part in path.relative_to(ROOT).parts):
            continue
        assert not ambiguous.search(path.read_text()), path
