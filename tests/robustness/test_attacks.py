"""Hostile inputs by the thousand, in about two hours: `pytest -m nightly`.

pytest -n 0 -s -m nightly -k networks tests/robustness         # one attack
ATTEMPTS=100 pytest -n 0 -m nightly tests/robustness           # fewer attempts of each
REPEAT=1234 pytest -n 0 -s -m nightly -k networks tests/robustness   # that attempt alone
"""

import os
import time

import attack
import pytest

pytestmark = pytest.mark.nightly
SEED = 0


@pytest.mark.parametrize("name", attack.SIZES)
def test_hostile_input_is_refused_or_runs(name, tmp_path):
    if "REPEAT" in os.environ:
        assert attack.repeat(name, int(os.environ["REPEAT"]), SEED, tmp_path) in attack.GOOD
        return
    number, _ = attack.SIZES[name]
    number = min(number, int(os.environ.get("ATTEMPTS", number)))
    outcomes = attack.attack(name, range(number), SEED, tmp_path)
    print(f"\n{name}:", {outcome: len(numbers) for outcome, numbers in outcomes.items()})
    bad = {outcome: numbers[:20] for outcome, numbers in outcomes.items()}
    for outcome in attack.GOOD:
        bad.pop(outcome, None)
    assert not bad


def _raise():
    raise KeyError


@pytest.mark.parametrize(
    ("event", "expected"),
    [
        (_raise, "traceback: KeyError in _raise"),
        (lambda: os._exit(3), "crash: it ended"),
        (lambda: os.kill(os.getpid(), 9), "crash: SIGKILL"),
        (lambda: time.sleep(60), "hang"),
    ],
)
def test_outcome_of_each_attempt_is_reported_and_the_others_are_made(event, expected):
    def attempt(number):
        if number == 2:
            event()
        return "ran"

    outcomes = dict(attack.children.outcomes(attempt, range(5), 3, 2, 500))
    assert outcomes == {0: "ran", 1: "ran", 2: expected, 3: "ran", 4: "ran"}
