"""Render docs/reference/pretrained.md from the pretrained networks and the JSON files beside them.

python docs/make_model_cards.py
"""

from pathlib import Path

from roboarm_nmp.envs.perception.encoders import pretrained_encoders
from roboarm_nmp.policies.cards import encoder_card, observes, policy_card
from roboarm_nmp.policies.registry import pretrained_policies
from roboarm_nmp.utils.files import write_atomically

PAGE = Path(__file__).parent / "reference" / "pretrained.md"
GOALS = {
    "ee": "an end-effector position",
    "config": "a configuration",
    "combined": "a configuration and its end-effector position",
}
TEXT = """\
# Pretrained policies and encoders

These networks are part of the installation. `roboarm policies` prints the same tables, and
`roboarm policies NAME --json` all flags of a policy's training. Use a policy by its name:

```
roboarm evaluate --policy sac-ee-wall-p1-s1
```

A name consists of trainer, goal type, encoder (if any), task and seed; `p` is the probability of
injecting demonstrations (`--demo-prob`). Every policy is measured on the first test queries of its
task, under the standard rules: at most 400 steps, contacts allowed.
Collision-free success counts the episodes that reach the goal without any contact. Intervals are
95 % Wilson intervals over queries, for this one network; other seeds differ more
([results](../benchmark/results.md)).
"""
FIXED = "Policies for one fixed scene. They observe nothing of the scene."
VARYING = """\
The goal is a configuration and its end-effector position. The test scenes do not occur in training.
An observation of ground-truth obstacles is privileged: a robot does not have it.
`roadmap-bc-combined-point_cloud-containers-s1` learned in `containers` and `random_boxes_hard`; its
filter has [approach paths](../guide/safety_filter.md#approach-paths).
`flow-combined-point_cloud-wide_scenes-s1` learned in [wide scenes](../benchmark/wide_scenes.md) and
in `random_boxes_hard`; it [draws and verifies paths](../algorithms/flow.md) before it moves.
Policies in scenes of other kinds: [unseen obstacles](../benchmark/unseen_obstacles.md)."""
ENCODERS = """\
An encoder's name is a value of `--encoder`; an encoder with a decoder is also a geometry source
(`--geometry-source`). How they work: [perception](../guide/perception.md)."""
RATES = ("success", "95 % interval", "collision-free success", "test queries")


def page():
    """The text of the page."""
    cards = [policy_card(name) for name in pretrained_policies()]
    blind = [card for card in cards if observes(card) == "nothing"]
    seeing = [card for card in cards if card not in blind]
    parts = [TEXT]
    for goal, words in GOALS.items():
        parts.append(f"## Goal `{goal}`: {words}\n\n{FIXED}\n")
        rows = [
            [f"`{card['name']}`", f"`{card['task']}`", _training(card), *_rates(card)]
            for card in blind
            if card["goal_type"] == goal
        ]
        parts.append(_table(["policy", "task", "training", *RATES], rows))
    assert all(card["goal_type"] == "combined" for card in seeing), "the text says so"
    parts.append(f"## Scenes that vary\n\n{VARYING}\n")
    rows = [
        [
            *(f"`{card['name']}`", f"`{card['task']}`", observes(card), _margin(card)),
            *(_training(card), *_rates(card)),
        ]
        for card in seeing
    ]
    head = ["policy", "task", "observes of the scene", "margin of the safety filter (m)"]
    parts.append(_table([*head, "training", *RATES], rows))
    parts.append(f"## Scene encoders\n\n{ENCODERS}\n")
    rows = [
        [
            *(f"`{card['name']}`", card["receives"], str(card["sensors"])),
            *(f"`{card['task']}`", f"{card['scenes']:,}", f"{card['updates']:,}"),
            "yes" if card["has_decoder"] else "no",
        ]
        for card in map(encoder_card, pretrained_encoders())
    ]
    head = ["encoder", "receives", "sensors", "scenes from", "scenes", "updates", "decoder"]
    parts.append(_table(head, rows))
    return "\n".join(parts)


def _training(card):
    return f"{card['steps']:,} {card['unit']}"


def _margin(card):
    return f"{card['safety_filter']['margin']:g}" if card["safety_filter"] else "none"


def _rates(card):
    low, high = card["success_rate_interval"]
    rates = card["success_rate"], card["collision_free_success_rate"]
    success, collision_free = (f"{rate:.3f}" for rate in rates)
    return success, f"{low:.3f}\u00a0to\u00a0{high:.3f}", collision_free, f"{card['num_queries']:,}"


def _table(head, rows):
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    write_atomically(PAGE, page().encode())
    print(f"{PAGE} written")
