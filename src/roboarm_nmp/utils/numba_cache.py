"""The decorator `compiled`: Numba's `njit` with a cache on disk that survives damaged files.

The cache is in the user's cache folder (`utils.files.cache_folder`), or in `NUMBA_CACHE_DIR`.
Numba trusts its cache. A truncated file raises `EOFError` in every process from then on, and a
file with a few wrong bytes can crash the process. Here each entry has a checksum. A damaged file is
named on stderr, ignored, and replaced by a new compilation.

Numba compiles a function again when the file that it stands in changes, but not when functions or
constants change that it uses from other files. Here an entry also counts as old when any of the
package's compiled files changes, all of which have names that end in `kernels.py`.
"""
# pyright: reportAttributeAccessIssue=false, reportPrivateImportUsage=false
# (Numba's settings and dispatchers have attributes that their types lack.)

import contextlib
import fcntl
import functools
import gc
import hashlib
import os
import pickle
import platform
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numba
from llvmlite.binding import get_host_cpu_name
from numba.core import compiler, config, event, sigutils, types, typing
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.codegen import JITCodeLibrary
from numba.core.serialize import dumps

from roboarm_nmp.utils.files import cache_folder
from roboarm_nmp.utils.progress import write_line

PACKAGE = Path(__file__).parents[1]


def uncounted(function):
    """`compiled`, for functions that make no arrays: it does not count references to them.

    Counting takes a fifth of the time of short functions that are called millions of times.
    """
    return compiled(function, _nrt=False)


def inlined(function):
    """`uncounted`, for functions whose calls cost more than they do: Numba passes an array as seven
    numbers.
    """
    return compiled(function, _nrt=False, forceinline=True)


def compiled(function, **options):
    """Numba's `njit`, cached on disk where a folder for that can be written to."""
    if config.DISABLE_JIT:
        return function
    dispatcher = numba.njit(nogil=True, error_model="numpy", **options)(function)
    inner = _Inner(dispatcher)
    dispatcher.get_call_template, dispatcher.get_overload = inner.get_call_template, inner.get_key
    folder = config.CACHE_DIR
    # (RuntimeError: no folder can be written to. OSError: there is no home folder.)
    with contextlib.suppress(RuntimeError, OSError):
        try:  # Numba's own setting, for this function only
            config.CACHE_DIR = folder or str(cache_folder() / "numba")
            dispatcher._cache = _CheckedCache(function)
        finally:
            config.CACHE_DIR = folder
    return dispatcher


class _WithoutCollector(event.Listener):
    """While Numba compiles, Python's collector of cycles rests: it takes a tenth of that time."""

    def __init__(self):
        self._running = 0  # compilations, which may be parts of others
        self._was_enabled = False

    def on_start(self, event):
        if self._running == 0:
            self._was_enabled = gc.isenabled()
            gc.disable()
        self._running += 1

    def on_end(self, event):
        self._running -= 1
        if self._running == 0 and self._was_enabled:
            gc.enable()


event.register("numba:compile", _WithoutCollector())


class _Inner:
    """A compiled function as other compiled functions call it: its code becomes part of theirs.

    By itself, Numba makes machine code of each function that is called, too, which nobody runs, and
    optimises what that one calls once more in each caller's caller.
    """

    def __init__(self, dispatcher):
        self._dispatcher = dispatcher
        self._compiled = {}  # of tuples of arguments' types, a signature and Numba's key

    def get_call_template(self, args, kws):
        """As of a dispatcher: a template, the Python signature, arguments' types, and {}."""
        pysig, args = self._dispatcher._compiler.fold_argument_types(args, kws)
        # A call with a number in the code, f(a, 0), is one with any integer.
        args = tuple(types.unliteral(kind) for kind in args)
        if args not in self._compiled:
            self._compiled[args] = self._compile(args)
        name = self._dispatcher.py_func.__name__
        signatures = [self._compiled[args][0]]
        template = typing.make_concrete_template(name, key=name, signatures=signatures)
        return template, pysig, args, {}

    def get_key(self, sig):
        """The key under which Numba knows the function of a signature's arguments."""
        return self._compiled[tuple(sigutils.normalize_signature(sig)[0])][1]

    def _compile(self, args):
        target = self._dispatcher.targetdescr
        flags = _Flags()
        target.options.parse_as_flags(flags, self._dispatcher.targetoptions)
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        function = self._dispatcher.py_func
        context = target.target_context
        library = _LinkedLibrary(context.codegen(), function.__qualname__)
        result = compiler.compile_extra(
            target.typing_context, context, function, args, None, flags, {}, library
        )
        key = object()
        context.insert_user_function(key, result.fndesc, [library])
        return result.signature, key


class _Flags(compiler.Flags):
    """Numba's flags, compared in a tenth of the time: it does that for each operation it types."""

    __slots__ = ()

    def __eq__(self, other):
        return isinstance(other, _Flags) and self._values == other._values

    def __hash__(self):
        return hash(_Flags)


class _LinkedLibrary(JITCodeLibrary):
    """Code that is linked into other functions', and optimised and made machine code there."""

    def _optimize_final_module(self):
        pass

    def _finalize_final_module(self):
        self._finalize_dynamic_globals()
        self._finalized = True


@functools.cache
def _announce_compilation(folder):
    """Print a line when this process compiles first, unless another is compiling.

    The lock on a file in the cache's folder is held to the end of this process.
    """
    global _lock
    with contextlib.suppress(OSError):
        _lock = open(Path(folder, "compiling"), "wb")  # noqa: SIM115
        fcntl.flock(_lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if _on_compilation is None:
            write_line("compiling once, about half a minute (roboarm compile: for all commands)")


_on_compilation: Callable[[], None] | None = None


@contextlib.contextmanager
def watch_compilations(function: Callable[[], None]) -> Iterator[None]:
    """A context in which a function is called before each compilation, instead of the line."""
    global _on_compilation
    _on_compilation = function
    try:
        yield
    finally:
        _on_compilation = None


def _stamp() -> Path:
    """A file in the cache that is there once all was compiled for this machine. Raises OSError."""
    parts = _kernels_digest(), numba.__version__, platform.machine(), get_host_cpu_name()
    name = hashlib.sha256(" ".join(parts).encode()).hexdigest()[:16]
    return Path(config.CACHE_DIR or cache_folder() / "numba", f"compiled-{name}")


def is_compiled() -> bool:
    """Whether `mark_compiled` was called for these functions on such a machine."""
    try:
        return _stamp().exists()
    except OSError:  # there is no cache
        return False


def mark_compiled() -> None:
    """Remember that all functions are in the cache."""
    with contextlib.suppress(OSError):
        _stamp().parent.mkdir(parents=True, exist_ok=True)
        _stamp().touch()


class _CheckedResult(CompileResultCacheImpl):
    """A compiled function as bytes and their checksum."""

    def reduce(self, result):
        payload = dumps(super().reduce(result))
        return hashlib.sha256(payload).digest(), payload

    def rebuild(self, target_context, data):
        checksum, payload = data
        if hashlib.sha256(payload).digest() != checksum:
            raise ValueError("wrong checksum")
        return super().rebuild(target_context, pickle.loads(payload))


@functools.cache
def _kernels_digest():
    """SHA-256 (hex) of all of the package's files whose names end in `kernels.py`."""
    paths = []
    for folder, _, names in os.walk(PACKAGE, followlinks=True):
        paths += [Path(folder, name) for name in names if name.endswith("kernels.py")]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(paths))).hexdigest()


class _CheckedCache(FunctionCache):
    """The cache of one function: an index file, and a data file for each signature."""

    _impl_class = _CheckedResult

    def __init__(self, function):
        super().__init__(function)
        file = self._cache_file
        file._source_stamp = (file._source_stamp, _kernels_digest())

    def load_overload(self, sig, target_context):
        try:
            overload = super().load_overload(sig, target_context)
            if overload is None:
                _announce_compilation(self.cache_path)
                if _on_compilation is not None:
                    _on_compilation()
            return overload
        except Exception:  # unpickling wrong bytes raises exceptions of many types
            path = self._damaged_path(sig, target_context)
            print(f"{path}: damaged, the function is compiled again", file=sys.stderr)
            with contextlib.suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig, data):
        try:
            super().save_overload(sig, data)
        except Exception as error:  # a full disk, or a folder where a file should be
            print(f"{self.cache_path}: {self._name} is not cached: {error}", file=sys.stderr)

    def _damaged_path(self, sig, target_context):
        file = self._cache_file
        try:
            name = file._load_index()[self._index_key(sig, target_context.codegen())]
        except Exception:
            return file._index_path
        return file._data_path(name)
