"""Hostile inputs: a few of those of tests/robustness/attack.py, and, marked `slow`, all of them."""

import os  # noqa: F401 (these two for what happens)
import time  # noqa: F401

import attack
import pytest

FEW = {
    "networks": 30,
    "files": 300,
    "robots": 30,
    "clouds": 400,
    "problems": 60,
    "trajectories": 200,
    "environments": 400,
    "flags": 17,
    "kills": 2,
}


def check(name, number, folder, seed):
    found = attack.attack(name, range(number), seed, folder)
    assert set(found) <= set(attack.GOOD), {word: found[word][:5] for word in found}
    assert sum(map(len, found.values())) == number
    return found


@pytest.mark.parametrize("name", sorted(FEW.keys() - {"kills"}))
def test_a_few(name, tmp_path):
    found = check(name, FEW[name], tmp_path, seed=7)
    assert len(found[attack.children.REFUSED]) > FEW[name] / 3


@pytest.mark.slow
@pytest.mark.parametrize("name", attack.SIZES)
def test_all(name, tmp_path):
    check(name, attack.SIZES[name], tmp_path, seed=0)


@pytest.mark.parametrize(
    ("happening", "expected"),
    [
        ("raise KeyError", "traceback: KeyError in attempt"),
        ("os._exit(3)", "crash: it ended"),
        ("os.kill(os.getpid(), 9)", "crash: SIGKILL"),
        ("time.sleep(60)", "hang"),
        ("bytearray(10**10)", "traceback: MemoryError in attempt"),
    ],
)
def test_outcome_of_each_attempt_is_reported_and_the_others_are_made(happening, expected):
    source = (
        f"import os, time\ndef attempt(number):\n    if number == 2: {happening}\n    return 'ran'"
    )
    namespace = {}
    exec(source, namespace)
    found = dict(attack.children.outcomes(namespace["attempt"], range(5), 3, 2, 500))
    assert found == dict.fromkeys(range(5), "ran") | {2: expected}
