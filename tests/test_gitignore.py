"""What README's commands write is ignored by Git, and nothing that the repository tracks."""

import re
import subprocess

import pytest
from paths import ROOT

OUTPUTS = re.compile(r"--(?:output|record|json|image|runs-dir|folder)[ =]([\w./-]+)")

pytestmark = pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a Git repository")


def git(*arguments):
    command = ["git", "-c", "safe.directory=*", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True).stdout.split()


def test_outputs_of_the_commands_in_the_readme_are_ignored():
    outputs = set(OUTPUTS.findall((ROOT / "README.md").read_text())) | {"runs/a/policy.onnx"}
    assert set(git("check-ignore", *outputs)) == outputs


def test_no_tracked_file_is_ignored():
    assert git("ls-files") and not git("ls-files", "--cached", "--ignored", "--exclude-standard")
