"""Flipped bits and truncations of every kind of file that the project writes."""

import contextlib
import hashlib
import io
import json
import random

import numpy as np
import torch

from attacks.children import RAN, REFUSED
from attacks.networks import Mixed, inputs
from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.journal import Journal, journal_of
from roboarm_nmp.datasets.observations import Observations
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.datasets.roadmap_paths import load_roadmap_paths
from roboarm_nmp.demo_generation import collect, make_queries, roadmaps
from roboarm_nmp.envs.scenes.files import load_scene, save_scene
from roboarm_nmp.envs.tasks import get_task
from roboarm_nmp.networks.export import save_network
from roboarm_nmp.networks.network_file import load_network
from roboarm_nmp.networks.untrusted import NetworkError
from roboarm_nmp.scene_embedding_train import collect as observe
from roboarm_nmp.scene_embedding_train.training_data import EncoderFlags
from roboarm_nmp.training.runs import Run

UNCHANGED, CHANGED = "read, as it was", "silent change"
TEXTS = ("scene", "args")  # any change of these may be a user's


def digest(*contents):
    """SHA-256 of arrays, and of values that JSON can have."""
    sha = hashlib.sha256()
    for content in contents:
        if isinstance(content, np.ndarray):
            sha.update(f"{content.dtype} {content.shape}".encode() + content.tobytes())
        else:
            sha.update(json.dumps(content, default=str, sort_keys=True).encode())
    return sha.hexdigest()


def make_files(folder):
    """Make one file of each kind in a folder: dict from the kind to its path."""
    task = folder / "mine.yaml"
    save_scene(get_task("boxes").scene, task)
    paths = {"scene": task, "network": folder / "network.onnx"}
    torch.manual_seed(0)
    save_network(paths["network"], Mixed(), inputs(), {"kind": "encoder"}, ["latent"])
    paths["queries"], paths["demos"] = folder / "mine_queries.h5", folder / "mine_demos.h5"
    make_queries.make_queries(paths["queries"], str(task), 0, 20, 5, progress=False)
    options = collect.options_of(collect.Args(str(task)))
    collect.collect(paths["demos"], 4, options, progress=False)
    paths["journal"] = journal_of(folder / "other.h5")
    with contextlib.closing(Journal(paths["journal"], options)) as journal:
        for index in range(20):
            journal.append({"index": index, "plan": "A" * 30 * index})
    small = {"scenes": 2, "paths_per_scene": 4, "num_nodes": 100, "workers": 1}
    roadmaps.collect(roadmaps.Args(folder / "roadmaps", **small), progress=False)
    paths["roadmaps"] = folder / "roadmaps" / "shard_00000.h5"
    small = {"num": 2, "image_size": 32, "num_samples": 400, "workers": 1}
    observe.collect(observe.Args(output=folder / "observations", **small), progress=False)
    paths["observations"] = folder / "observations" / "shard_00000.h5"
    run = Run(EncoderFlags(runs_dir=folder / "runs"), "mine", parts_of_a_run())
    run.save()
    paths |= {"checkpoint": run.folder / "checkpoint.pt", "args": run.folder / "args.json"}
    return paths


def parts_of_a_run():
    model = torch.nn.Linear(9, 7)
    return {
        "model": model,
        "optimizer": torch.optim.Adam(model.parameters()),
        "progress": {"steps": 100, "best": 0.25},
        "rng": np.random.default_rng(0),
    }


def content_of(kind, path):
    """A digest of the contents that the project's reader returns; for a journal a dict of them."""
    if kind == "scene":
        return digest(repr(load_scene(path)))
    if kind == "network":
        network = load_network(path)
        output = network(**inputs())
        return digest(network.metadata, output.detach().numpy())
    if kind == "queries":
        splits = [load_queries(path, name) for name in ("test", "validation")]
        return digest(*(array for split in splits for array in (split.start, split.goal)))
    if kind == "demos":
        demos = load_demos(path)
        arrays = [array for demo in demos for array in (demo.plan, demo.states, demo.actions)]
        return digest(demos.parameters, demos.made_by, demos.seed, *arrays)
    if kind == "journal":
        options = collect.options_of(collect.Args(str(path.with_name("mine.yaml"))))
        with contextlib.closing(Journal(path, options)) as journal:
            return {index: digest(entry) for index, entry in journal.entries.items()}
    if kind == "roadmaps":
        paths = load_roadmap_paths(path.parent)
        rows = [repr(scene) for scene in paths.scenes]
        return digest(paths.task, paths.seed, rows, paths.points, paths.offsets, paths.path_offsets)
    if kind == "observations":
        made = Observations(path.parent)
        names = [f"{name}/rgb" for name in made.sensors if not name.endswith("cloud")]
        names += [f"{name}/depth" for name in made.sensors if name.endswith("cloud")]
        arrays = [made.read(0, name) for name in ("configuration", *names)]
        return digest(made.task, made.seed, repr(made.sensors), repr(made.scenes(0)), *arrays)
    if kind == "checkpoint":
        parts = parts_of_a_run()
        with contextlib.redirect_stdout(io.StringIO()):
            Run(EncoderFlags(resume=path.parent), "mine", parts)
        model, rng = parts["model"], parts["rng"].bit_generator.state
        arrays = [parameter.detach().numpy() for parameter in model.parameters()]
        return digest(*arrays, parts["optimizer"].state_dict(), parts["progress"], rng)
    return digest(json.loads(path.read_text()))


def attempts(seed, folder):
    """The attempt: a function from a number to the outcome of reading a damaged file."""
    paths = make_files(folder)
    originals = {kind: path.read_bytes() for kind, path in paths.items()}
    contents = {kind: content_of(kind, path) for kind, path in paths.items()}
    kinds = sorted(paths)

    def attempt(number):
        rng = random.Random(f"{seed} {number}")
        kind = kinds[number % len(kinds)]
        damaged = bytearray(originals[kind])
        place = rng.randrange(len(damaged))
        if rng.random() < 0.3:
            del damaged[place:]
        else:
            damaged[place] ^= 1 << rng.randrange(8)
        paths[kind].write_bytes(damaged)
        messages = io.StringIO()
        try:
            with contextlib.redirect_stderr(messages):
                content = content_of(kind, paths[kind])
        except (DatasetError, NetworkError):
            return REFUSED
        except SystemExit as end:
            return REFUSED if isinstance(end.code, str) and "\n" not in end.code else "unclear"
        except ValueError:
            if kind in ("journal", *TEXTS):
                return REFUSED
            raise
        finally:
            paths[kind].write_bytes(originals[kind])
        if content == contents[kind]:
            return UNCHANGED
        if kind == "journal":
            # Damaged lines are left out with a message. The end may be missing, as after a kill.
            fits = content.items() <= contents[kind].items()
            ended = len(damaged) < len(originals[kind]) or not damaged.endswith(b"\n")
            return REFUSED if fits and (messages.getvalue() or ended) else CHANGED
        return RAN if kind in TEXTS else CHANGED

    return attempt
