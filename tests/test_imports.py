"""Arrows between modules point one way: no import cycle, no upward import."""

import ast
import graphlib

from paths import ROOT

from roboarm_nmp.__main__ import TRAINERS

PACKAGE = "roboarm_nmp"
FOLDERS = ("envs", "demo_generation", "clean_rl_scripts", "bc_script", "scene_embedding_train")
# From the bottom to the top. A module may import from its own row and from the rows before it.
LEVELS = [
    ("envs.utils",),
    ("envs.robots",),
    ("envs.scenes", "envs.networks", "envs.subgoals"),
    ("envs.world", "envs.collision", "envs.tasks"),
    ("envs.arm_env", "envs.perception", "envs.wrappers"),
    ("envs",),  # `make`
    ("envs.datasets", "envs.policies"),
    ("envs.metrics", "envs.time_parameterisation"),
    ("envs.training",),
    ("envs.show", "envs.robot_check", "envs.import_problems", "envs.retime"),
    ("envs.viewer",),
    ("demo_generation",),
    ("clean_rl_scripts", "bc_script", "scene_embedding_train"),
]


def modules():
    """Names of all modules, without `roboarm_nmp.`, and their files."""
    files = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")]
    found = {}
    for path in files:
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(path, known):
    """Names of the project's modules that a file imports, in functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        for name in names:
            top, _, name = name.partition(".")
            if top == PACKAGE:  # the longest part of the name that is a module
                while name not in known:
                    name = name.rpartition(".")[0]
                found.add(name)
    return found


def level_of(module):
    """The row of `LEVELS` with the module, or with the package that it is in."""
    rows = {name: row for row, names in enumerate(LEVELS) for name in names}
    if module in rows:
        return rows[module]
    parent = module.rpartition(".")[0]
    assert parent not in ("", "envs"), f"{module} has no level: add it to LEVELS"
    return level_of(parent)


GRAPH = {name: imports(path, modules()) for name, path in modules().items()}


def test_there_is_no_import_cycle():
    graphlib.TopologicalSorter(GRAPH).prepare()  # or it raises CycleError


def test_no_module_imports_from_a_higher_level():
    upward = [
        f"{name} imports {other}"
        for name, others in GRAPH.items()
        for other in others
        if level_of(other) > level_of(name)
    ]
    assert not upward, upward


def test_trainers_do_not_import_each_other():
    trainers = {module for module, _ in TRAINERS.values()}
    assert trainers <= GRAPH.keys()
    between = {name: GRAPH[name] & trainers for name in trainers}
    assert not any(between.values()), between


def test_no_module_is_imported_by_an_ambiguous_name():
    """`import envs` would find whichever folder of that name comes first."""
    for path in ROOT.rglob("*.py"):
        if any(part.startswith(".") or part == "build" for part in path.relative_to(ROOT).parts):
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                tops = [alias.name.split(".")[0] for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                tops = [(node.module or "").split(".")[0]]
            else:
                continue
            assert not set(tops) & set(FOLDERS), f"{path}:{node.lineno}"
