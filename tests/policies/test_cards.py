"""Model cards of the pretrained policies and encoders: their numbers, the command, the page."""

import importlib.util
import json

from paths import ROOT

from roboarm_nmp.envs.perception.encoders import pretrained_encoders
from roboarm_nmp.policies import __main__ as command
from roboarm_nmp.policies.cards import observes, policy_card
from roboarm_nmp.policies.registry import find_policy, own_safety_filter, pretrained_policies

PRETRAINED = "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"


def test_cards_agree_with_the_files_and_the_measured_results():
    for name in pretrained_policies():
        card = policy_card(name)
        path, arguments = find_policy(name)
        assert card["goal_type"] == arguments["goal_type"]
        assert card["encoder"] == arguments.get("encoder")
        own = own_safety_filter(path)
        assert card["safety_filter"] == (own and own.to_metadata())
        low, high = card["success_rate_interval"]
        assert 0 <= card["collision_free_success_rate"] <= card["success_rate"] <= high
        assert low <= card["success_rate"] and card["num_queries"] >= 400
    measured = json.loads((ROOT / "benchmarks/results/unseen_obstacles.json").read_text())
    measured = measured["random_boxes_hard"]["roadmap BC, point_cloud"]
    card = policy_card(PRETRAINED)
    for key in ("success_rate", "collision_free_success_rate", "num_queries"):
        assert card[key] == measured[key]
    assert observes(card) == "32 points and link distances from point_cloud"
    assert observes(policy_card("sac-ee-wall-p1-s1")) == "nothing"
    assert observes(policy_card("bc-combined-vae-random_boxes_hard-s1")) == "latent code of vae"


def test_policies_and_encoders_are_listed(capsys):
    assert command.main([]) == 0
    policies, encoders = capsys.readouterr().out.strip().split("\n\n")
    rows = policies.splitlines()[1:]
    assert [row.split()[0] for row in rows] == list(pretrained_policies())
    for row in rows:
        card = policy_card(row.split()[0])
        assert card["task"] in row and row.endswith(f" {card['num_queries']:,}")
        assert (" margin 0.0" in row) == (card["safety_filter"] is not None)
    assert [row.split()[0] for row in encoders.splitlines()[1:]] == pretrained_encoders()


def test_one_policy_is_shown_and_a_misspelt_one_is_suggested(capsys):
    assert command.main([PRETRAINED]) == 0
    shown = capsys.readouterr().out
    assert "0.9299 (95% interval 0.9247 to 0.9347)" in shown and "0.8531" in shown
    assert command.main([PRETRAINED, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == policy_card(PRETRAINED)
    assert command.main(["--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [card["name"] for card in listed["policies"]] == list(pretrained_policies())
    assert command.main(["roadmap-bc-combined"]) == 2
    assert command.main(["sac-ee-wall-s1"]) == 2
    assert "did you mean sac-ee-wall-p1-s1?" in capsys.readouterr().err


def test_page_of_the_docs_is_what_is_rendered():
    path = ROOT / "docs" / "make_model_cards.py"
    spec = importlib.util.spec_from_file_location("make_model_cards", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.PAGE.read_text() == module.page(), "run python docs/make_model_cards.py"
