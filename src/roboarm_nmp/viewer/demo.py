"""The pretrained point-cloud policy beside go-to-goal, in an unseen scene, in the browser.

    roboarm demo

The same as `roboarm view random_boxes_hard --policy POLICY go-to-goal --query QUERY`.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from roboarm_nmp.utils import flags
from roboarm_nmp.viewer.app import PORT, Args, Port, view

TASK, POLICY = "random_boxes_hard", "roadmap-bc-combined-point_cloud-random_boxes_hard-s1"
QUERY = 10  # of the test queries: the policy has no contact, go-to-goal has many


@dataclass
class DemoArgs:
    record: Path | None = None
    """write a replay into this HTML file, instead of opening the page"""
    host: str = "127.0.0.1"
    """address to listen at; 0.0.0.0 for all of this machine's"""
    port: Port = PORT
    """port to listen at"""
    open: bool = True
    """open the page in the browser"""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command. Returns the exit code: 0, or 2 where nothing can be viewed."""
    args = flags.parse(DemoArgs, arguments, others="viewer")
    return view(Args(task=TASK, policy=(POLICY, "go-to-goal"), query=QUERY, **vars(args)))


if __name__ == "__main__":
    sys.exit(main())
