"""The command `roboarm policies`: the pretrained policies and scene encoders.

roboarm policies
roboarm policies sac-ee-wall-p1-s1
roboarm policies sac-ee-wall-p1-s1 --export policy.onnx
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.policies.baselines import BASELINES
from roboarm_nmp.policies.registry import PolicyError, find_policy, pretrained_policies
from roboarm_nmp.utils.files import write_atomically
from roboarm_nmp.utils.signals import error_line


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command. Returns the exit code: 0, or 2 for an error."""
    parser = argparse.ArgumentParser(
        prog="roboarm policies",
        description="List the pretrained policies and scene encoders, or show one policy. Success "
        "is measured on test queries of the policy's task, with the policy's own safety filter.",
        epilog="example: roboarm policies sac-ee-wall-p1-s1",
    )
    parser.add_argument("name", nargs="?", metavar="NAME", help="show the card of this policy")
    parser.add_argument(
        "--json", action="store_true", help="print JSON, with all flags of training"
    )
    parser.add_argument(
        "--export",
        type=Path,
        metavar="FILE",
        help="copy the ONNX file of the policy NAME (here also a run's folder or a file) to FILE, "
        "and print its inputs and outputs (docs/guide/run_elsewhere.md)",
    )
    options = parser.parse_args(arguments)
    if options.export is not None:
        if options.name is None:
            parser.error("--export needs the NAME of a policy")
        try:
            print(_export(options.name, options.export))
        except (PolicyError, OSError) as error:
            print(error_line(error), file=sys.stderr)
            return 2
        return 0
    # Here, so that --help need not wait for it.
    from roboarm_nmp.envs.perception.encoders import pretrained_encoders
    from roboarm_nmp.policies.cards import encoder_card, policy_card

    if options.name is not None:
        try:
            card = policy_card(options.name)
        except PolicyError as error:
            print(error_line(error), file=sys.stderr)
            return 2
        print(json.dumps(card, indent=2) if options.json else _card(card))
        return 0
    policies = [policy_card(name) for name in pretrained_policies()]
    encoders = [encoder_card(name) for name in pretrained_encoders()]
    if options.json:
        print(json.dumps({"policies": policies, "encoders": encoders}, indent=2))
    else:
        print(_policies(policies), _encoders(encoders), sep="\n\n")
    return 0


def _export(name, path):
    """Copy a policy's network file; its inputs and outputs in words."""
    source, _ = find_policy(name)
    if source in BASELINES:
        raise PolicyError(f"{name} is a baseline, which has no network file")
    write_atomically(path, Path(source).read_bytes())
    network = load_network(path)
    rows = [("", "name", "shape, float32")]
    for kind, shapes in (("input", network.inputs), ("output", network.outputs)):
        for tensor, shape in shapes.items():
            sizes = ", ".join("N" if size is None else str(size) for size in shape)
            rows.append((kind, tensor, f"({sizes})"))
    return f"{path}\n{_aligned(rows, numbers=0)}"


def _policies(cards):
    from roboarm_nmp.policies.cards import observes

    rows = [
        ("policy", "task", "goal", "observes of the scene", "safety filter")
        + ("success", "collision-free", "queries")
    ]
    for card in cards:
        rows.append(
            (
                card["name"],
                card["task"],
                card["goal_type"],
                observes(card),
                _filter(card),
                f"{card['success_rate']:.3f}",
                f"{card['collision_free_success_rate']:.3f}",
                f"{card['num_queries']:,}",
            )
        )
    return _aligned(rows, numbers=3)


def _encoders(cards):
    rows = [("encoder", "receives", "trained on", "decoder", "scenes")]
    for card in cards:
        receives = f"{card['receives']} of {card['sensors']} sensors"
        decoder = "yes" if card["has_decoder"] else "no"
        rows.append((card["name"], receives, card["task"], decoder, f"{card['scenes']:,}"))
    return _aligned(rows, numbers=1)


def _filter(card):
    return f"margin {card['safety_filter']['margin']:g} m" if card["safety_filter"] else "none"


def _aligned(rows, numbers):
    """Rows of strings as text in columns; the last `numbers` columns end at their right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [text.ljust(width) for text, width in zip(row, widths, strict=True)]
        for i in range(len(row) - numbers, len(row)):
            cells[i] = row[i].rjust(widths[i])
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def _card(card):
    from roboarm_nmp.policies.cards import observes

    low, high = card["success_rate_interval"]
    rows = {
        "task": card["task"],
        "goal": card["goal_type"],
        "observes of the scene": observes(card),
        "safety filter": _filter(card),
        "success": f"{card['success_rate']:.4f} (95% interval {low:.4f} to {high:.4f})",
        "collision-free success": f"{card['collision_free_success_rate']:.4f}",
        "test queries": f"{card['num_queries']:,}",
        "trained by": f"{card['trainer']}, {card['steps']:,} {card['unit']}, {card['date']}",
        "evaluate it": f"roboarm evaluate --policy {card['name']}",
    }
    return "\n".join([card["name"], *(f"  {name:<24}{text}" for name, text in rows.items())])


if __name__ == "__main__":
    sys.exit(main())
