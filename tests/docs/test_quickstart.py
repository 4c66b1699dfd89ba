"""docs/quickstart.md is carried out from top to bottom, with fewer steps and queries."""

import re
import shlex
import urllib.request
from pathlib import Path

import pytest
from paths import ROOT
from PIL import Image
from tensorboard import program
from trainers import PATHS, TINIER, run_here, short_evaluations

from roboarm_nmp import __main__

PAGE = (ROOT / "docs/quickstart.md").read_text().replace(" \\\n   ", "")
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```", PAGE, re.S | re.M)
COMMANDS = [line for kind, text in BLOCKS if not kind for line in text.splitlines()]
FEWER = {"evaluate": "--num-queries 3 --workers 1", "show": "--size 80 60"}


def run(command):
    """A command of the page, in this process and the current folder."""
    words = shlex.split(command.replace("RUN", next(Path().glob("runs/*"), Path()).name))
    if words[0] == "tensorboard":
        board = program.TensorBoard()
        board.configure([*words, "--port", "0"])
        with urllib.request.urlopen(board.launch() + "data/runs", timeout=30) as answer:
            print(answer.read().decode())
    elif words[:3] == ["roboarm", "train", "sac"]:
        tiny = "--total-timesteps 600" if "--resume" in words else TINIER
        run_here(PATHS["sac_her_mp"], *words[3:], *tiny.split())
    else:
        with pytest.raises(SystemExit) as end:
            __main__.main([*words[1:], *FEWER[words[1]].split()])
        assert not end.value.code, command


def test_page_works_from_top_to_bottom(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [])  # a command changes it
    printed, names = {}, {}
    for kind, text in BLOCKS:
        if kind == "python":
            exec(text, names)
        for line in text.splitlines() if not kind else ():
            if line != "roboarm demo":  # it stays open; tests/envs/viewer has its tests
                capsys.readouterr()
                with short_evaluations(120):
                    run(line)
                printed[line] = capsys.readouterr().out
    assert names["execution"].reached and not names["execution"].collided
    assert names["observation"]["desired_goal"].shape == (3,)
    assert Image.open("wall.png").size == (80, 60) and Image.open("episode.gif").n_frames > 5
    [folder] = Path("runs").iterdir()
    assert folder.name in printed["tensorboard --logdir runs"]
    of_run, pretrained, baseline = (
        next(out for line, out in printed.items() if f"evaluate --policy {name}" in line)
        for name in ("runs/RUN", "roadmap-bc", "go-to-goal")
    )
    assert folder.name in of_run and "on no_obstacles: 3 test queries" in of_run
    success = [
        float(re.search(r"^  success +(\S+)", out, re.M)[1]) for out in (pretrained, baseline)
    ]
    assert success[0] > 0.5 > success[1]
