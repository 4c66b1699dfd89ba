"""Installing: under any Python, and found under its own name beside folders of the same names."""

import os
import re
import shutil
import subprocess
import sys
import textwrap

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from paths import ROOT

PYTHONS = ("3.10", "3.11", "3.12", "3.13", "3.14")
OWN_FOLDERS = ("envs", "tests", "benchmarks", "demo_generation")
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


def run(*command, cwd, **variables):
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | variables
    done = subprocess.run(
        [sys.executable, *map(str, command)], cwd=cwd, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_later_python_is_accepted():
    """Without an upper bound: pip would refuse a Python that nobody has tried yet."""
    project = (ROOT / "pyproject.toml").read_text()
    accepted = SpecifierSet(re.search(r'^requires-python = "(.*)"', project, re.MULTILINE)[1])
    assert all(version in accepted for version in (*PYTHONS, "3.15", "4.0"))
    assert "3.9" not in accepted
    assert set(re.findall(r"Python :: (3\.\d+)", project)) == set(PYTHONS)


@pytest.mark.parametrize("python", PYTHONS)
def test_constraints_pin_each_package_once_within_the_declared_range(python):
    def applies(requirement):
        return not requirement.marker or requirement.marker.evaluate({"python_version": python})

    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = [Requirement(line) for line in lines if not line.startswith("#")]
    pins = [pin for pin in pins if applies(pin)]
    versions = {pin.name.lower(): re.fullmatch("==(.+)", str(pin.specifier))[1] for pin in pins}
    assert len(versions) == len(pins)
    project = (ROOT / "pyproject.toml").read_text()
    needed = re.search(r"^dependencies = \[(.*?)^\]", project, re.MULTILINE | re.DOTALL)[1]
    for requirement in map(Requirement, re.findall(r'^ +"(.+?)"', needed, re.MULTILINE)):
        assert versions[requirement.name] in requirement.specifier, requirement


def test_install_page_lists_every_extra():
    project = (ROOT / "pyproject.toml").read_text()
    extras = re.search(r"optional-dependencies\]\n(.*?)^\[", project, re.MULTILINE | re.DOTALL)[1]
    page = (ROOT / "docs" / "install.md").read_text()
    assert re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE) == re.findall(
        r"^(\w+) = ", extras, re.MULTILINE
    )


def test_package_works_beside_folders_of_the_same_names(project):
    assert "works from" in run("use.py", cwd=project)


def test_copied_trainer_runs_in_any_folder(project):
    shutil.copy(ROOT / "clean_rl_scripts" / "sac_her_mp.py", project / "mine.py")
    tiny = "--hidden-size 8 --batch-size 8 --horizon 20 --learning-starts 40 --num-envs 2"
    tiny += " --eval-every 60 --eval-queries 1 --test-queries 1 --total-timesteps 60"
    assert "1 test queries: success" in run("mine.py", *tiny.split(), cwd=project)


def test_trainer_of_the_checkout_runs_from_any_folder(project):
    script = ROOT / "clean_rl_scripts" / "sac_her_mp.py"
    assert "--total-timesteps" in run(script, "--help", cwd=project)


def test_wheel_is_complete_and_not_replaced_by_a_package_named_envs(project, tmp_path):
    source, site = tmp_path / "source", tmp_path / "site"
    endings = ("*.py", "*.toml", "*.md", "*.h5", "*.pt", "*.json", "*.typed", "src/roboarm_nmp/*")
    listed = ["git", "ls-files", "-z", "--", *endings]
    files = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for file in filter(None, files.split("\0")):
        if not file.startswith(("tests/", "docs/", "benchmarks/")):
            (source / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / file, source / file, follow_symlinks=False)
    options = ["--no-deps", "--no-build-isolation", "--quiet", "--target", site]
    run("-m", "pip", "install", *options, source, cwd=tmp_path)
    (site / "envs").mkdir()
    (site / "envs" / "__init__.py").write_text("")  # as `pip install envs` brings it
    output = run("use.py", cwd=project, PYTHONPATH=str(site))
    assert f"works from {site}" in output
    code = "import roboarm_nmp.policies.registry as r; print(len(r.pretrained_policies()))"
    assert int(run("-c", code, cwd=project, PYTHONPATH=str(site))) > 10
    arguments = [
        "evaluate",
        "--policy",
        "sac-ee-wall-p1-s1",
        "--task",
        "wall",
        "--num-queries",
        "2",
    ]
    output = run("-m", "roboarm_nmp", *arguments, cwd=project, PYTHONPATH=str(site))
    assert "sac-ee-wall-p1-s1" in output
