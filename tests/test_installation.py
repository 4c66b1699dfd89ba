"""Installing: under any Python, and found under its own name beside folders of the same names."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import textwrap
import zipfile
from pathlib import Path

import jedi
import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from paths import ROOT

PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
OWN_FOLDERS = ("envs", "tests", "benchmarks", "demo_generation")
UNCOMPILED = {"NUMBA_DISABLE_JIT": "1"}  # for a few steps; compiling takes half a minute
USE = """
    import multiprocessing
    import sys

    import roboarm_nmp


    def steps(task):
        env = roboarm_nmp.make(task)
        env.reset(seed=0)
        return float(env.step(env.action_space.sample() * 0)[0]["observation"].sum())


    if __name__ == "__main__":
        here = steps("wall")
        for method in ("spawn", "forkserver"):
            with multiprocessing.get_context(method).Pool(1) as pool:
                assert pool.map(steps, ["wall"]) == [here], method
        print("works from", roboarm_nmp.__file__)
"""


@pytest.fixture
def project(tmp_path):
    """A person's folder that has folders and modules with the names of ours."""
    folder = tmp_path / "project"
    for name in OWN_FOLDERS:
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text("raise ImportError('another package')")
    (folder / "use.py").write_text(textwrap.dedent(USE))
    return folder


def run(*command, cwd, python=sys.executable, **variables):
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | variables
    done = subprocess.run(
        [python, *map(str, command)], cwd=cwd, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_later_python_is_accepted():
    """Without an upper bound: pip would refuse a Python that nobody has tried yet."""
    project = (ROOT / "pyproject.toml").read_text()
    accepted = SpecifierSet(re.search(r'^requires-python = "(.*)"', project, re.MULTILINE)[1])
    assert all(version in accepted for version in (*PYTHONS, "3.15", "4.0"))
    assert "3.9" not in accepted
    old = "import runpy, sys; sys.version_info = (3, 9, 18); runpy.run_path('setup.py')"
    done = subprocess.run([sys.executable, "-c", old], cwd=ROOT, capture_output=True, text=True)
    assert done.stderr.startswith("RoboArm-NMP needs Python 3.10 or later, and this is 3.9")
    assert set(re.findall(r"Python :: (3\.\d+)", project)) == set(PYTHONS)


@pytest.mark.parametrize("python", PYTHONS)
def test_constraints_pin_each_package_once_within_the_declared_range(python):
    def applies(requirement):
        return not requirement.marker or requirement.marker.evaluate({"python_version": python})

    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [Requirement(line) for line in lines if not line.startswith("#")]
    pins = [pin for pin in pins if applies(pin)]
    versions = {}
    for pin in pins:
        versions[canonicalize_name(pin.name)] = re.fullmatch("==(.+)", str(pin.specifier))[1]
    assert len(versions) == len(pins)
    project = (ROOT / "pyproject.toml").read_text()
    needed = re.search(r"^dependencies = \[(.*?)^\]", project, re.MULTILINE | re.DOTALL)[1]
    for requirement in map(Requirement, re.findall(r'^ +"(.+?)"', needed, re.MULTILINE)):
        assert versions[canonicalize_name(requirement.name)] in requirement.specifier, requirement


def test_package_works_beside_folders_of_the_same_names(project):
    assert "works from" in run("use.py", cwd=project)
    names = run("-c", "import roboarm_nmp; print(*dir(roboarm_nmp))", cwd=project).split()
    assert names == ["TASKS", "evaluate", "make"]


def test_copied_trainer_runs_in_any_folder(project):
    shutil.copy(ROOT / "clean_rl_scripts" / "sac_her_mp.py", project / "mine.py")
    tiny = "--hidden-size 8 --batch-size 8 --horizon 20 --learning-starts 40 --num-envs 2"
    tiny += " --eval-every 60 --eval-queries 1 --test-queries 1 --total-timesteps 60"
    assert "1 test queries: success" in run("mine.py", *tiny.split(), cwd=project)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of the checkout's files, links included, as a fresh clone has them."""
    folder = tmp_path_factory.mktemp("clone")
    listed = ["git", "ls-files", "-z", "--", ":!tests", ":!docs", ":!benchmarks"]
    files = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for file in filter(None, files.split("\0")):
        if os.path.lexists(ROOT / file):
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / file, folder / file, follow_symlinks=False)
    return folder


def build(kind, source, folder):
    """What pip builds of a folder, `wheel`, `sdist` or `editable`: a file in `folder`."""
    code = f"import sys; from setuptools import build_meta as b; b.build_{kind}(sys.argv[1])"
    run("-c", code, folder, cwd=source)
    [path] = folder.iterdir()
    return path


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory):
    """A wheel of the clone."""
    return build("wheel", source, tmp_path_factory.mktemp("wheel"))


def test_wheel_from_the_source_distribution_is_the_one_of_the_clone(source, wheel, tmp_path):
    for folder in ("sdist", "unpacked", "wheel"):
        (tmp_path / folder).mkdir()
    with tarfile.open(build("sdist", source, tmp_path / "sdist")) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    [unpacked] = (tmp_path / "unpacked").iterdir()
    names = [
        set(zipfile.ZipFile(path).namelist())
        for path in (wheel, build("wheel", unpacked, tmp_path / "wheel"))
    ]
    assert names[0] == names[1]
    tracked = subprocess.run(
        ["git", "ls-files", "envs", "src/roboarm_nmp"], cwd=ROOT, capture_output=True, text=True
    )
    for file in tracked.stdout.split():
        name = file.removeprefix("src/") if file.startswith("src") else f"roboarm_nmp/{file}"
        if not (ROOT / file).is_dir() and (ROOT / file).exists():  # a link to a folder
            assert name in names[0]


def test_wheel_works_and_is_not_replaced_by_a_package_named_envs(project, wheel, tmp_path):
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    (tmp_path / "envs").mkdir()
    (tmp_path / "envs" / "__init__.py").write_text("")  # as `pip install envs` brings it
    installed = {"PYTHONPATH": str(tmp_path), **UNCOMPILED}
    assert f"works from {tmp_path}" in run("use.py", cwd=project, **installed)
    code = "import roboarm_nmp.policies.registry as r; print(len(r.pretrained_policies()))"
    assert int(run("-c", code, cwd=project, **installed)) > 10
    evaluate = "evaluate --policy sac-ee-wall-p1-s1 --task wall --num-queries 2 --workers 1"
    output = run("-m", "roboarm_nmp", *evaluate.split(), cwd=project, **installed)
    assert "sac-ee-wall-p1-s1" in output


@pytest.fixture(scope="module")
def python(source, tmp_path_factory):
    """Python of a virtual environment in which `pip install -e` has installed the clone."""
    folder = tmp_path_factory.mktemp("venv")
    run("-m", "venv", "--without-pip", folder, cwd=folder)
    [site] = folder.glob("lib/python*/site-packages")
    with zipfile.ZipFile(build("editable", source, tmp_path_factory.mktemp("editable"))) as archive:
        archive.extractall(site)
    # The dependencies are those of this Python.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    return folder / "bin" / "python"


def test_editable_install_runs_scripts_directly_from_any_folder(project, source, python):
    output = run("use.py", cwd=project, python=python, **UNCOMPILED)
    assert f"works from {source}" in output
    script = source / "clean_rl_scripts" / "sac_her_mp.py"
    assert "--total-timesteps" in run(script, "--help", cwd=project, python=python)


def test_editors_complete_names_of_an_editable_install(source, python):
    environment = jedi.create_environment(python.parent.parent, safe=False)

    def completed(code):
        return {name.name for name in jedi.Script(code, environment=environment).complete()}

    assert {"make", "evaluate", "TASKS"} <= completed("import roboarm_nmp; roboarm_nmp.")
    code = "from roboarm_nmp.envs.arm_env import RoboArmEnv"
    [found] = jedi.Script(code, environment=environment).goto(1, len(code), follow_imports=True)
    assert found.type == "class" and found.module_path.name == "arm_env.py"
    assert {"reset", "step", "reset_specific"} <= completed(f"{code}; RoboArmEnv.")
    assert "plan" in completed("from roboarm_nmp.planning.planner import Planner; Planner.")


def test_copied_trainer_has_no_type_errors(tmp_path, python):
    pyright = Path(sysconfig.get_path("scripts"), "pyright")
    version = subprocess.run([pyright, "--version"], capture_output=True, cwd=tmp_path)
    if version.returncode != 0:
        pytest.skip("pyright cannot run: it downloads Node.js the first time")
    shutil.copy(ROOT / "clean_rl_scripts" / "sac_her_mp.py", tmp_path / "mine.py")
    command = [pyright, "--pythonpath", python, "--outputjson", "mine.py"]
    checked = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    result = json.loads(checked.stdout)
    assert result["summary"]["filesAnalyzed"] == 1
    assert result["generalDiagnostics"] == []
