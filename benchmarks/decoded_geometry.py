"""Geometry in a latent code: the occupied cells that can be decoded from z_E.

    python benchmarks/decoded_geometry.py                  # pretrained encoders, oracle, mean
    python benchmarks/decoded_geometry.py runs/RUN/encoder.onnx --json geometry.json

The space around the robot is divided into cells of 0.2 m. A cell is occupied if an obstacle
overlaps it. A probe, a network with two layers of 256, predicts the occupied cells from z_E. The
oracle is a set: its probe receives one obstacle at a time, and the predictions are combined. Probes
are trained on scenes of the demonstrations of `random_boxes_hard` and tested on those of its test
queries, 2,000 that no encoder was trained on. Two scores, over all cells that are not always empty:

- information: the share of the uncertainty that z_E removes, 1 - (cross-entropy of the prediction)
  / (cross-entropy of each cell's mean); 0 for the mean, 1 for perfect predictions;
- IoU: of the cells predicted as occupied (probability above one half) and the occupied ones. For an
  encoder with a decoder also of the cells with decoded obstacles, without a probe: those nearer
  than a distance that is chosen on training scenes.

Of an encoder with a decoder also `decoded`: the mean error in cm of the links' distances from
decoded points, for links within 10 cm of an obstacle, at `POSES` random configurations per scene.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import torch.nn as nn
import torch.nn.functional as F
from tqdm import tqdm

from roboarm_nmp.datasets.demonstrations import load_demos
from roboarm_nmp.datasets.queries import load_queries
from roboarm_nmp.envs.collision.checker import CollisionChecker
from roboarm_nmp.envs.perception.encoders import (
    DECODED_REACH,
    MAX_OBSTACLES,
    ORACLE,
    make_encoder,
    pretrained_encoders,
)
from roboarm_nmp.envs.perception.geometry_source import DECODED_RADIUS
from roboarm_nmp.envs.scenes.primitives import ROW, to_array

TASK = "random_boxes_hard"
CELL = 0.2  # m
LOW, HIGH = np.array([-0.8, -0.8, 0.0]), np.array([0.8, 0.8, 1.6])
POSES, NEAR, FAR = 16, 0.1, 0.4  # NEAR, FAR: m
# m: a decoded point nearer than this to an obstacle occupies its cell; one of them is chosen.
REACHES = [-0.005, 0.0, 0.0025, 0.005, 0.0075, 0.01, DECODED_REACH]
SHAPE = tuple(np.round((HIGH - LOW) / CELL).astype(int))


def occupied(obstacles):
    """Cells that obstacles overlap: bool `SHAPE`.

    By separating axes, the boxes' faces and the cells': exact for upright boxes, slightly too many
    cells for others; cylinders and spheres count as their boxes.
    """
    centres = LOW + CELL * (np.stack(np.indices(SHAPE), axis=-1) + 0.5)
    cells = np.zeros(SHAPE, bool)
    for row in to_array(obstacles):
        axes, half = _rotation(row[4:8]), row[8:11] / 2
        if row[0] > 0:  # radii
            half = row[8:11] * ([1, 1, 0.5] if row[0] == 1 else 1)
        offset = centres - row[1:4]
        along_cell = np.abs(offset) < CELL / 2 + np.abs(axes) @ half
        along_box = np.abs(offset @ axes) < half + CELL / 2 * np.abs(axes).sum(0)
        cells |= along_cell.all(-1) & along_box.all(-1)
    return cells


def link_distances(scenes, seed):
    """The links' distances (scenes, POSES, 10), m, from obstacles, and the random configurations.

    These are (scenes, POSES, 7), normalised.
    """
    states = np.random.default_rng(seed).uniform(-1.0, 1.0, (len(scenes), POSES, 7))
    distances = [
        CollisionChecker(replace(scene, table=None, floor=None)).link_distances(batch, within=FAR)
        for scene, batch in zip(tqdm(scenes, desc="distances"), states, strict=True)
    ]
    return np.stack(distances)[..., 0], states


def _rotation(quaternion):
    """(x, y, z, w) -> (3, 3), the box's axes as columns."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


class AnyObstacle(nn.Module):
    """The oracle's z_E (n, 384) -> logits (n, cells), from those of `network` for each obstacle."""

    def __init__(self, network):
        super().__init__()
        self.network = network

    def forward(self, latents):
        rows = latents.unflatten(1, (MAX_OBSTACLES, 1 + ROW))
        rows = rows[:, : int(rows[..., 0].sum(1).max())]
        free = (F.logsigmoid(-self.network(rows)) * rows[..., :1]).sum(1).clamp(max=-1e-6)
        return torch.log(-torch.expm1(free)) - free


def probe(latents, cells, test_latents, is_set=False, seed=0, epochs=60):
    """Train the probe; its probabilities (n, cells) on the test scenes.

    A tenth of the training scenes selects the epoch.
    """
    torch.manual_seed(seed)
    if not is_set:
        mean, std = latents.mean(0), latents.std(0) + 1e-3
        latents, test_latents = (latents - mean) / std, (test_latents - mean) / std
    latents, test_latents = torch.as_tensor(latents), torch.as_tensor(test_latents)
    cells = torch.as_tensor(cells).float()
    split = len(latents) * 9 // 10
    network = nn.Sequential(
        nn.Linear(1 + ROW if is_set else latents.shape[1], 256), nn.ReLU(),
        nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, cells.shape[1]),
    )  # fmt: skip
    if is_set:
        network = AnyObstacle(network)
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3, weight_decay=0.1)
    best = np.inf
    probabilities = None
    for _ in range(epochs):
        for rows in torch.randperm(split).split(128):
            loss = F.binary_cross_entropy_with_logits(network(latents[rows]), cells[rows])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        with torch.no_grad():
            error = F.binary_cross_entropy_with_logits(network(latents[split:]), cells[split:])
            if error < best:
                best = error
                probabilities = torch.sigmoid(network(test_latents))
    return probabilities.numpy()


def cells_of(points):
    """Cells that contain points (n, 3), m: bool (all cells,)."""
    grid = np.zeros(SHAPE, bool)
    at = np.floor((points - LOW) / CELL).astype(int)
    grid[tuple(at[((at >= 0) & (at < SHAPE)).all(1)].T)] = True
    return grid.ravel()


def decoded(name, training, cells, testing, test_cells, test_data):
    """Errors of the points that a decoder gives: a dict of `decoded_iou` and `decoded_cm`.

    Args:
        name: of an encoder with a decoder.
        training, testing: scenes. The first 200 of `training` select the distance below which a
            decoded point occupies its cell.
        cells, test_cells: bool (n, all cells), the truth.
        test_data: of `testing`, see `link_distances`.
    """
    encoder = make_encoder(name)

    def nearer(scene, points, reach):
        return points[encoder.distances(scene, points) < reach]

    def iou(guess, truth):
        return float((guess & truth).sum() / (guess | truth).sum())

    guesses = {reach: [] for reach in REACHES}
    for scene in tqdm(training[:200], desc="decoded, to select"):
        points = encoder.decoded_points(scene)
        for reach, grids in guesses.items():
            grids.append(cells_of(nearer(scene, points, reach)))
    best = max(REACHES, key=lambda reach: iou(np.stack(guesses[reach]), cells[:200]))
    grids, errors = [], []
    distances, states = test_data
    for scene, truth, batch in zip(tqdm(testing, desc="decoded"), distances, states, strict=True):
        points = encoder.decoded_points(scene)
        grids.append(cells_of(nearer(scene, points, best)))
        bare = replace(scene, obstacles=(), table=None, floor=None)
        checker = CollisionChecker(bare, points, DECODED_RADIUS)
        error = np.abs(checker.link_distances(batch, within=FAR)[..., 0] - truth)
        errors.append(error[truth < NEAR])
    mean = 100 * float(np.concatenate(errors).mean())
    return {"decoded_iou": iou(np.stack(grids), test_cells), "decoded_cm": mean}


def latents(names, scenes):
    """z_E of scenes by each encoder, float32 (n, size), by name.

    Encoders with the same sensors share their observations.
    """
    groups = []  # of encoders
    for encoder in map(make_encoder, names):
        for group in groups:
            if group[0].sensors == encoder.sensors:
                group.append(encoder)
                break
        else:
            groups.append([encoder])
    codes = {name: [] for name in names}
    for scene in tqdm(scenes, desc="observing"):
        for group in groups:
            observed = group[0].observe(scene)
            for encoder in group:
                codes[encoder.name].append(encoder.encode(observed))
    return {name: np.stack(z) for name, z in codes.items()}


def cross_entropy(probabilities, cells):
    """Mean over scenes and cells, in nats."""
    p = np.clip(probabilities, 1e-6, 1 - 1e-6)
    return float(-np.where(cells, np.log(p), np.log(1 - p)).mean())


def scores(probabilities, means, cells):
    """The scores of the module's docstring; `means` (cells,) are the training scenes'."""
    guess = probabilities > 0.5
    means = np.broadcast_to(means, cells.shape)
    return {
        "information": 1 - cross_entropy(probabilities, cells) / cross_entropy(means, cells),
        "iou": float((guess & cells).sum() / (guess | cells).sum()),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "encoders", nargs="*", help="networks (encoder.onnx); default: the pretrained"
    )
    parser.add_argument("--num", type=int, default=10_000, help="scenes to train on (10,000)")
    parser.add_argument("--num-test", type=int, default=2_000, help="scenes to test on (2,000)")
    parser.add_argument("--json", type=Path, help="write the scores to this file, too")
    args = parser.parse_args()
    torch.set_num_threads(1)
    demos, queries = load_demos(TASK), load_queries(TASK)
    training = [demos.scenes[i] for i in range(min(args.num, len(demos)))]
    testing = list(dict.fromkeys(queries.scenes[i] for i in range(len(queries))))[: args.num_test]
    grids = [
        np.stack([occupied(scene.obstacles).ravel() for scene in tqdm(scenes, desc="cells")])
        for scenes in (training, testing)
    ]
    sometimes = grids[0].any(0)
    cells, test_cells = (grid[:, sometimes] for grid in grids)
    means = cells.mean(0)
    test_data = link_distances(testing, 1)
    results = {"mean": scores(means[None].repeat(len(test_cells), 0), means, test_cells)}
    names = args.encoders or pretrained_encoders()
    codes, test_codes = latents(names, training), latents(names, testing)
    codes[ORACLE], test_codes[ORACLE] = (
        np.stack([make_encoder(ORACLE)(scene) for scene in scenes])
        for scenes in (training, testing)
    )
    for name in tqdm([ORACLE, *names], desc="encoders"):
        probabilities = probe(codes[name], cells, test_codes[name], is_set=name == ORACLE)
        result = scores(probabilities, means, test_cells)
        if make_encoder(name).decoder is not None:
            result |= decoded(name, training, grids[0], testing, grids[1], test_data)
        results[name] = result
        if args.json is not None:
            args.json.write_text(json.dumps(results, indent=1) + "\n")
    print(f"{len(training)} scenes to train on, {len(testing)} to test on, {cells.shape[1]} cells,")
    print(f"{test_cells.mean():.3f} of them occupied")
    for name, result in results.items():
        line = f"{name:40} information {result['information']:.3f}  IoU {result['iou']:.3f}"
        if "decoded_cm" in result:
            line += f"; decoded: IoU {result['decoded_iou']:.3f}, {result['decoded_cm']:.2f} cm"
        print(line)


if __name__ == "__main__":
    main()
