"""Point clouds: files of every format with one to three random changes."""

import io
import random

import cloud_examples
import numpy as np
from PIL import Image

from attacks.children import RAN, REFUSED
from roboarm_nmp.datasets.cloud_files import CloudError, load_cloud
from roboarm_nmp.envs.perception.point_clouds import prepare_cloud

INTRINSICS = 20.0, 20.0, 4.0, 4.0
# What replaces a number or a word of a header.
ODD = (b"0", b"-1", b"1e9", b"99999999999", b"20000000", b"4294967296", b"nan", b"", b"x", b"f8")
ODD += (
    b"(9, 9)",
    b"'|O'",
    b"'<U9'",
    b"list",
    b"vertex",
    b"face",
    b"DATA",
    b"ascii",
    b"\n",
    b"\xff",
)


def files():
    """Contents of the files before changes: dict from the name to bytes."""
    depth = io.BytesIO()
    pixels = np.random.default_rng(1).integers(0, 2000, (9, 9)).astype(np.uint16)
    Image.fromarray(pixels).save(depth, "PNG")
    return cloud_examples.FILES | {"depth.png": depth.getvalue()}


def damaged(contents, rng):
    """The bytes with one to three changes; `rng` is `Random`."""
    for _ in range(rng.randint(1, 3)):
        kind, place = rng.random(), rng.randrange(len(contents) + 1)
        if kind < 0.4:  # a word of the header, or of the first rows
            words = contents[:300].split(b" ")
            words[rng.randrange(len(words))] = rng.choice(ODD)
            contents = b" ".join(words) + contents[300:]
        elif kind < 0.6:
            contents = contents[:place] + bytes([rng.randrange(256)]) + contents[place + 1 :]
        elif kind < 0.8:
            contents = contents[:place] + rng.randbytes(rng.choice((1, 4, 100))) + contents[place:]
        elif kind < 0.9:
            contents = contents[:place]
        else:
            lines = contents.split(b"\n")
            del lines[rng.randrange(len(lines))]
            contents = b"\n".join(lines)
    return contents


def attempts(seed, folder):
    """A function from a number to the outcome of reading and preparing such a cloud."""
    originals = sorted(files().items())
    for name, contents in originals:  # so that everything is compiled
        (folder / name).write_bytes(contents)
        prepare_cloud(load_cloud(folder / name, intrinsics=INTRINSICS if "png" in name else None))

    def attempt(number):
        rng = random.Random(f"{seed} {number}")
        name, contents = originals[number % len(originals)]
        path = folder / name
        path.write_bytes(damaged(contents, rng))
        try:
            points = load_cloud(path, intrinsics=INTRINSICS if name.endswith("png") else None)
        except CloudError as error:
            assert str(error).startswith(f"{path}: ") and "\n" not in str(error)
            return REFUSED
        prepared, removed = prepare_cloud(points)
        assert len(points) == len(prepared) + sum(removed.values())
        assert np.isfinite(prepared).all()
        return RAN

    return attempt
