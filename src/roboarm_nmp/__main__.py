"""The command `roboarm`: every script of the project under one name.

Each subcommand runs its script as `python -m` does. So a trainer stays a file that is read from top
to bottom, and the processes that it spawns find it under its module's name.
"""

import gc
import runpy
import sys
from collections.abc import Sequence

from roboarm_nmp.utils.names import suggest
from roboarm_nmp.utils.signals import end_with_one_line, flush_output

TRAINERS = {
    "sac": ("clean_rl_scripts.sac_her_mp", "SAC with HER and demonstrations"),
    "td3": ("clean_rl_scripts.td3_her_mp", "TD3 with HER and demonstrations"),
    "crl": ("clean_rl_scripts.crl_mp", "contrastive RL with hindsight and demonstrations"),
    "bc": ("bc_script.bc", "behavioural cloning of demonstrations"),
    "gciql": ("bc_script.gciql", "offline goal-conditioned implicit Q-learning"),
    "diffusion": ("bc_script.diffusion", "diffusion policy: chunks of actions, by denoising"),
    "roadmap-bc": ("bc_script.roadmap_bc", "imitation of roadmap paths: policies for new scenes"),
    "flow": ("bc_script.flow", "flow matching of whole paths, verified before the arm moves"),
    "vae": ("scene_embedding_train.vae", "scene encoder: VAE of camera images"),
    "vqvae": ("scene_embedding_train.vqvae", "scene encoder: VQ-VAE of camera images"),
    "pointnet2": ("scene_embedding_train.pointnet2", "scene encoder: PointNet++ of point clouds"),
    "field": ("scene_embedding_train.field", "scene encoder: distance field of point clouds"),
}
COMMANDS = {
    "train": (None, "train a policy or a scene encoder: roboarm train --help"),
    "evaluate": ("clean_rl_scripts.evaluate", "evaluate a policy on the queries of a task"),
    "benchmark": ("evaluation.benchmark", "enter a method into the benchmark, verify an entry"),
    "policies": ("policies", "list the pretrained policies and encoders"),
    "show": ("viewer.show", "image or animation of a task and of a policy"),
    "view": ("viewer.app", "policies in the browser; move goal and obstacles"),
    "demo": ("viewer.demo", "a pretrained policy in the browser, without arguments"),
    "compile": ("viewer.compile", "compile collision checks and plans, once per machine"),
    "retime": ("motions.retime", "make an executable trajectory of a joint path"),
    "sweep": ("clean_rl_scripts.sweep", "search a trainer's flags with Optuna"),
    "plan": ("demo_generation.plan", "plan a motion among points or in a scene"),
    "import": ("datasets.import_problems", "import problems, or motions of a LeRobot dataset"),
    "queries": ("demo_generation.make_queries", "make a query file"),
    "collect": ("demo_generation.collect", "collect demonstrations"),
    "verify": ("demo_generation.verify", "replay demonstrations in the simulator"),
    "export": ("demo_generation.export", "export demonstrations as a LeRobot or Minari dataset"),
    "roadmaps": (
        "demo_generation.roadmaps",
        "make roadmap paths, for `roboarm train roadmap-bc --paths`",
    ),
    "observations": ("scene_embedding_train.collect", "collect observations, for scene encoders"),
    "robot": ("viewer.robot_check", "describe and verify an arm: roboarm robot check FILE"),
    "data": ("datasets", "validate or describe files of queries and demonstrations"),
}


def _usage(prog: str, commands: dict) -> str:
    rows = [f"  {name:<14}{summary}" for name, (_, summary) in commands.items()]
    return "\n".join([f"usage: {prog} COMMAND [--help] ...", "", *rows])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a subcommand.

    Returns the exit code: 0, 1 without a package that it needs, 2 for an unknown command.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    prog = "roboarm"
    commands = COMMANDS
    if arguments[:1] == ["train"]:
        prog = "roboarm train"
        commands = TRAINERS
        arguments = arguments[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_usage(prog, commands))
        return 0 if arguments else 2
    name = arguments[0]
    if name not in commands:
        hint = suggest(name, commands)
        print(f"{prog}: unknown command {name!r}: {hint}", file=sys.stderr)
        return 2
    gc.set_threshold(50_000)  # PyTorch's import makes many objects: 0.2 s of collections
    sys.argv = [f"{prog} {name}", *arguments[1:]]  # its first is replaced by the script's path
    end_with_one_line("nothing was written")  # until the script has better advice
    try:
        runpy.run_module(
            f"roboarm_nmp.{commands[name][0]}",
            init_globals={"PROGRAM": f"{prog} {name}"},  # for `utils.signals.program`
            run_name="__main__",
            alter_sys=True,
        )
    except ModuleNotFoundError as error:
        if error.name != "ompl":
            raise
        needs = f"{prog} {name} needs OMPL, which has no packages for every Python"
        print(f"{needs}: docs/install.md says for which", file=sys.stderr)
        return 1
    finally:
        flush_output()
        if commands is TRAINERS and {"-h", "--help"} & set(arguments):
            gc.freeze()  # the last collection would search PyTorch's objects: 0.4 s
    return 0


if __name__ == "__main__":
    sys.exit(main())
