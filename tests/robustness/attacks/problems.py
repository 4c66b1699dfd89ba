"""Files of problems in other programs' formats, with one to three random changes."""

import json
import random
import re

import numpy as np
import problem_files

from attacks.children import RAN, REFUSED
from roboarm_nmp.datasets.format import DatasetError
from roboarm_nmp.datasets.import_problems import import_problems, summary
from roboarm_nmp.datasets.problems import load_problems, write_problems
from roboarm_nmp.envs.scenes.formats import load_world
from roboarm_nmp.utils.documents import DocumentError

MEGABYTES = 1000
ODD = ("", "0", "-1", "nan", ".inf", "1e300", "-1e-300", "9" * 400, "null", "~", "[]", "{}", "*a")
ODD += ("[1, 2]", "{a: 1}", "&a [*a]", "!!python/object/apply:os.system ['touch hacked']", "'0.1'")
ODD += ("true", "cone", "mesh", "box", "panda_joint1", "/dev/zero", "\u202e", "\x00", "\t", "? ")
ODD += ("- " * 50, "[" * 50, "{" * 50, "<<: 1", "!!binary aGk=", "2026-11-27", "%YAML 9")
NUMBERS = (b"0", b"-1", b"1", b"0.5", b"nan", b".inf", b"1e300", b"1e-300", b"1e3", b"-0.02", b"7")
WORLDS = {
    "world.yaml": problem_files.MOVEIT_SCENE,
    "touching.yaml": problem_files.MOVEIT_TOUCHING,
    "curobo.yaml": problem_files.CUROBO,
    "new.scene": problem_files.SCENE_TEXT,
    "old.scene": problem_files.OLD_SCENE_TEXT,
    "meshes.yaml": problem_files.MOVEIT_MESH,
    "triangles.yaml": problem_files.CUROBO_TRIANGLES,
    "mesh.scene": problem_files.SCENE_MESH,
}
PROBLEMS = {
    "shelf/scene0001.yaml": problem_files.MOVEIT_SCENE,
    "shelf/request0001.yaml": problem_files.MOVEIT_REQUEST,
    "set.yaml": problem_files.ROBOMETRICS,
    "vamp.json": json.dumps(problem_files.VAMP, indent=1),
}


def hostile(rng, contents):
    """A file's bytes with one to three changes; `rng` is `Random`."""
    for _ in range(rng.randint(1, 3)):
        kind = rng.random()
        if kind < 0.1 or not contents:  # bytes
            changed = bytearray(contents or b"x")
            for _ in range(rng.choice((1, 1, 10))):
                changed[rng.randrange(len(changed))] = rng.randrange(256)
            contents = bytes(changed)
        elif kind < 0.12:
            contents = contents[: rng.randrange(len(contents))]
        elif kind < 0.45 and (numbers := list(re.finditer(rb"-?[\d.]+", contents))):
            old = rng.choice(numbers)
            contents = contents[: old.start()] + rng.choice(NUMBERS) + contents[old.end() :]
        else:
            lines = contents.decode(errors="replace").split("\n")
            at = rng.randrange(len(lines))
            if kind < 0.6:  # a value
                key, colon, _ = lines[at].rpartition(":")
                lines[at] = f"{key}{colon} {rng.choice(ODD)}"
            elif kind < 0.7:  # a word
                words = lines[at].split(" ")
                words[rng.randrange(len(words))] = rng.choice(ODD)
                lines[at] = " ".join(words)
            elif kind < 0.8:
                del lines[at]
            elif kind < 0.95:
                lines[at:at] = [rng.choice(lines)] * rng.choice((1, 1, 1000))
            else:
                lines[at] = lines[at] * rng.choice((2, 1000))
            contents = "\n".join(lines).encode()
    return contents


def attempts(seed, folder):
    """A function from a number to the outcome of reading and importing such a file."""
    source = folder / "source"
    source.mkdir()
    for name, content in PROBLEMS.items():
        (source / name).parent.mkdir(exist_ok=True)
        (source / name).write_text(content)
    write_problems(source / "problems.h5", load_problems(source / "set.yaml"))

    def attempt(number):
        rng, here = random.Random(f"{seed} {number}"), folder / str(number)
        here.mkdir()
        name = rng.choice([*WORLDS, *PROBLEMS, "problems.h5"])
        try:
            if name in WORLDS:
                path = here / name
                path.write_bytes(hostile(rng, WORLDS[name].encode()))
                assert np.isfinite(load_world(path).floor or 0.0)
                return RAN
            path = here / name
            path.parent.mkdir(exist_ok=True)
            if path.parent != here:  # the other file of the pair is as it was
                for other in (source / path.parent.name).iterdir():
                    (path.parent / other.name).write_bytes(other.read_bytes())
            path.write_bytes(hostile(rng, (source / name).read_bytes()))
            kept, rejected = import_problems([path.parent if path.parent != here else path])
            text = summary(kept, rejected)
        except (DatasetError, DocumentError) as error:
            assert str(here) in str(error) and "\n" not in str(error), error
            return REFUSED
        assert all(line.isprintable() for line in text.split("\n"))
        for problem in kept:
            assert np.isfinite(problem.goals).all() and np.isfinite(problem.start).all()
        if kept:
            write_problems(here / "again.h5", kept)
        return REFUSED if rejected else RAN

    return attempt
