import contextlib
import functools
import gc
import hashlib
import importlib.util
import os
import random
import signal
import sys

import meta_device
import numpy as np
import onnx
import pytest
import torch
from trainers import GPU, short_evaluations

from roboarm_nmp.datasets.demonstrations import load_demos, write_demos
from roboarm_nmp.networks import export
from roboarm_nmp.utils import workers
from roboarm_nmp.utils.files import write_atomically

# As many threads as a trainer has in a process of its own, whatever benchmarks set when they are
# imported: results are compared bit for bit.
torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))

# Ctrl-C can be tested also where it is ignored, as in the background of a shell.
signal.signal(signal.SIGINT, signal.default_int_handler)


class _SkipWithoutOmpl:
    """Importing OMPL skips the test or module that does it, where OMPL has no packages."""

    def find_spec(self, name, path=None, target=None):
        if name == "ompl":
            pytest.skip("OMPL has no packages for this Python", allow_module_level=True)


if importlib.util.find_spec("ompl") is None:
    sys.meta_path.append(_SkipWithoutOmpl())


# Files that take long begin first, so that no process is left alone with one. The first compiles
# the collision checks. The other process begins with files that need none of them.
LONG = (
    *("test_may_touch", "test_encoder_trainers", "test_collision", "test_learning", "test_bc"),
    *("test_trainers", "test_roadmap_bc", "test_flow", "test_collect", "test_installation"),
    *("test_evaluation", "test_trainers_of_robots", "test_devices", "test_datasets"),
    *("test_networks", "test_sac_her_mp", "test_benchmark", "test_examples", "test_commands"),
    *("test_vector_envs", "test_arm_env", "test_browser", "test_runs", "test_sweep"),
)


# Files for daily work, with the marker `fast`: less than a minute together.
FAST = {
    *("test_imports", "test_make", "test_wrappers", "test_scenes", "test_scene_files"),
    *("test_collision", "test_episodes", "test_policies", "test_signals"),
}


@pytest.hookimpl(tryfirst=True)  # before the items are selected by `-m`
def pytest_collection_modifyitems(items):
    for item in items:
        if item.path.stem in FAST and "slow" not in item.keywords:
            item.add_marker("fast")
    ranks = {name: rank for rank, name in enumerate(LONG)}
    items.sort(key=lambda item: ranks.get(item.path.stem, len(LONG)))


def pytest_collection_finish():
    """What all tests have imported is not looked through for garbage again and again."""
    gc.collect()
    gc.freeze()


def pytest_sessionfinish():
    gc.unfreeze()  # or OMPL's bindings name all that they think has leaked


@pytest.fixture(autouse=True)
def seeded():
    """What a test draws from global generators is the same in every run and order."""
    random.seed(0)
    np.random.seed(0)
    torch.manual_seed(0)


@pytest.fixture(scope="session", autouse=True)
def single_worker_is_this_process():
    """Where one process is asked for, this one does its jobs: another takes seconds to start."""
    run = workers.run

    def run_jobs(make_worker, arguments, jobs, number, *more, **others):
        if number == 1:
            yield from map(make_worker(*arguments), jobs)
        else:
            yield from run(make_worker, arguments, jobs, number, *more, **others)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workers, "run", run_jobs)
        yield


def structure_of(module):
    """All of a module but its parameters' values, as text."""
    parts = [(name, tuple(one.shape)) for name, one in module.named_parameters()]
    parts += [(name, one.numpy().tobytes()) for name, one in module.named_buffers()]
    for name, part in module.named_modules():
        code = type(part).forward.__code__
        public = {key: value for key, value in vars(part).items() if not key.startswith("_")}
        parts.append((name, code.co_filename, code.co_firstlineno, public))
    return repr(parts)


@functools.cache
def tabulate_operators_once():
    """PyTorch fills the same table of ONNX operators anew for every export, in a second."""
    with contextlib.suppress(ImportError):  # in another version of PyTorch
        from torch.onnx._internal.exporter._registration import ONNXRegistry

        ONNXRegistry.from_torchlib = staticmethod(functools.cache(ONNXRegistry.from_torchlib))


@pytest.fixture(scope="module", autouse=True)
def exports_once(tmp_path_factory):
    """PyTorch takes seconds to export a network, so those that differ in weights alone share one.

    They are in a folder that the processes of a run share. `save_network` compares each with its
    module. test_networks.py exports all of its own.
    """
    export_module, folder = export._export, tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    folder = folder / "exported"
    folder.mkdir(exist_ok=True)

    def export_once(module, inputs, *options):
        shapes = [(name, tuple(one.shape), one.dtype) for name, one in inputs.items()]
        structure = repr((structure_of(module), shapes, *options))
        path = folder / hashlib.sha256(structure.encode()).hexdigest()
        if not path.exists():
            tabulate_operators_once()
            model = export_module(module, inputs, *options)
            write_atomically(path, model.SerializeToString())
        model, weights = onnx.load(path), dict(module.named_parameters())
        for tensor in model.graph.initializer:
            if tensor.name in weights:
                array = weights[tensor.name].numpy()
                tensor.CopyFrom(onnx.numpy_helper.from_array(array, tensor.name))
        return model

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "_export", export_once)
        yield


@pytest.fixture(params=["meta", GPU])
def another_device(request):
    """`--device` for a trainer: a GPU, and `meta`, which stands in for one where there is none."""
    is_meta = request.param == "meta"
    with meta_device.in_cudas_place() if is_meta else contextlib.nullcontext():
        yield request.param


@pytest.fixture(params=["float64", "meta", GPU])
def torch_default(request):
    """A context in which PyTorch has another default dtype, or another default device."""

    @contextlib.contextmanager
    def context():
        if request.param == "float64":
            torch.set_default_dtype(torch.float64)
        else:
            torch.set_default_device(request.param)
        try:
            yield
        finally:
            torch.set_default_dtype(torch.float32)
            torch.set_default_device(None)

    return context


@pytest.fixture(scope="session")
def few_demos(tmp_path_factory):
    """A file of 20 demonstrations of `random_boxes_hard`: all 10,000 take seconds to load."""
    path, demos = tmp_path_factory.mktemp("demos") / "few.h5", load_demos("random_boxes_hard")
    ends = zip(demos.plan_offsets, demos.plan_offsets[1:21], strict=False)
    plans = [demos.plan[first:last] for first, last in ends]
    first = [demos[i] for i in range(20)]
    columns = {name: getattr(demos, name)[:20] for name in ("plan_seed", "digest", "collided")}
    scenes = {"scenes_of": [demo.scene for demo in first]}
    states = [demo.states for demo in first]
    given = (demos.task, demos.seed, plans, states, columns, "a test", demos.parameters)
    write_demos(path, *given, **scenes)
    return path


@pytest.fixture
def short_episodes():
    """Evaluations are over sooner."""
    with short_evaluations():
        yield


@pytest.fixture
def cluster():
    """A Ray cluster of two nodes on this machine, a core each."""
    cluster = pytest.importorskip("ray.cluster_utils").Cluster(
        initialize_head=True, head_node_args={"num_cpus": 0}
    )
    for _ in range(2):
        cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    yield cluster
    cluster.shutdown()
