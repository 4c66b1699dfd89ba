"""The trainers of scene encoders as modules and as commands, for the tests."""

import contextlib
import importlib.util
import sys
from unittest.mock import patch

import torch
from paths import ROOT

from roboarm_nmp.envs.perception.encoders import MAX_OBSTACLES, make_encoder
from roboarm_nmp.envs.perception.sensors import cardinal
from roboarm_nmp.envs.scenes.primitives import Box, Cylinder, Scene, Sphere
from roboarm_nmp.scene_embedding_train import collect

FOLDER = ROOT / "scene_embedding_train"
SCRIPTS = ("vae", "vqvae", "pointnet2", "field")
OF_CLOUDS = ("pointnet2", "field")
TINY = ["--total-updates", "8", "--eval-every", "4", "--eval-scenes", "6", "--batch-size", "8"]
TINY += ["--width", "4", "--validation-share", "0.3"]
TINY_CLOUDS = ["--num-points", "64", "--num-query-points", "50"]
TINY_POINTNET = ["--num-centres", "4", "3", "--num-neighbours", "4"]
OBSTACLES = (
    Box((0.3, 0.2, 0.5), (0.2, 0.1, 0.3), (0.5, 0.5, -0.1, 0.7)),
    Cylinder((-0.3, 0.2, 0.6), 0.1, 0.3, (0.1, -0.7, 0.1, 0.7)),
    Sphere((0.0, -0.4, 0.3), 0.12),
)


@contextlib.contextmanager
def two_sensors():
    """A context in which observations are of two sensors: fewer networks to export."""

    def two(*args, **options):
        return dict(list(cardinal(*args, **options).items())[:2])

    with patch.object(collect, "cardinal", two):
        yield


def obstacle_rows():
    """`OBSTACLES` as float32 (1, MAX_OBSTACLES, 12)."""
    z = make_encoder("oracle")(Scene(OBSTACLES))
    return torch.from_numpy(z.reshape(1, MAX_OBSTACLES, 12))


def load(name):
    """A trainer's script as a module."""
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def command(name, observations, folder, *flags):
    """A run of seconds; later flags win."""
    script = [sys.executable, str(FOLDER / f"{name}.py"), "--observations", str(observations)]
    tiny = [*TINY, *(TINY_CLOUDS if name in OF_CLOUDS else ["--image-size", "16"])]
    tiny += TINY_POINTNET if name == "pointnet2" else []
    return [*script, "--runs-dir", str(folder), *tiny, *flags]


def one_update(module, model, batch, args, *inputs):
    """The return value of `module.update`, with Adam."""
    optimizer = torch.optim.Adam(model.parameters(), lr=args.learning_rate, fused=True)
    return module.update(model, optimizer, batch, *inputs, args)


def check_step(model, before, loss, lr):
    """`model` is where Adam's first step leads from the weights `before`, whose loss was `loss`.

    That step is the learning rate against the sign of the gradient.
    """
    gradients = torch.autograd.grad(loss, list(before.parameters()), allow_unused=True)
    checked = 0
    for old, new, gradient in zip(before.parameters(), model.parameters(), gradients, strict=True):
        gradient = torch.zeros_like(old) if gradient is None else gradient
        clear = (gradient.abs() > 1e-5) | (gradient == 0)  # beside Adam's epsilon
        expected = (old - lr * gradient.sign())[clear]
        torch.testing.assert_close(new[clear], expected, rtol=0, atol=0.02 * lr)
        checked += int((gradient.abs() > 1e-5).sum())
    assert checked > 100
