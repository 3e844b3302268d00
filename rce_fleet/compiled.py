"""Compiled inner loops: the only module that imports numba.

A :class:`Kernel` is a function in two forms that give the same answer: a numpy one, which is used by default,
and a loop that numba compiles. :func:`compile_kernels` compiles the loops of the modules that are imported so
far; a node calls it while it starts, so that nothing compiles at a robot's first message::

    def _sum_numpy(values): return float(values.sum())

    @kernel("float64(float64[::1])", numpy=_sum_numpy)
    def total(values):
        result = 0.0
        for value in values:
            result += value
        return result

    compile_kernels()  # without this, total() is _sum_numpy()

numba keeps compiled loops on disk. ``rce compile`` compiles all of them into :data:`INSTALLED`, beside this
module; a process that may not write there, such as a node in a sandbox, copies them to a folder of its own.

Compiled loops release the interpreter's lock, so that threads can run them side by side. They may call
functions marked with :func:`helper`. They must not call themselves: numba's cache can end the process then.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_log = logging.getLogger(__name__)
COMPILED = "RCE_COMPILED"
"""Variable that turns compiled loops off: ``no``."""
_OFF = ("0", "no", "false", "off")
INSTALLED = Path(__file__).with_name("__compiled__")
"""Folder of numba's cache that ``rce compile`` fills."""
_kernels: list[Kernel[..., Any]] = []
_helpers: dict[Callable[..., Any], Any] = {}


class Kernel(Generic[P, R]):
    """A function with a numpy form and a form to compile; see the module.

    Attributes:
        loop: The form to compile, as plain Python.
        numpy: The numpy form.
    """

    def __init__(self, loop: Callable[P, R], signatures: tuple[str, ...], numpy: Callable[P, R]) -> None:
        self.loop = loop
        self.numpy = numpy
        self.__name__ = loop.__name__
        self.__doc__ = loop.__doc__
        self._signatures = signatures
        self._compiled: Any = None
        """numba's dispatcher."""
        self._used = numpy

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run the form that is in use."""
        return self._used(*args, **kwargs)

    @property
    def is_compiled(self) -> bool:
        """Whether calls run the compiled loop."""
        return self._used is self._compiled

    @property
    def was_cached(self) -> bool:
        """Whether numba's cache on disk had the compiled loop, in all of its forms."""
        return self._compiled is not None and not self._compiled.stats.cache_misses

    def compile(self) -> Callable[P, R]:
        """Compile the loop if that has not been done, and return it; calls still run what they ran before.

        Raises:
            ImportError: numba is not installed.
        """
        if self._compiled is None:
            self._compiled = _jit(self.loop, list(self._signatures))
        compiled: Callable[P, R] = self._compiled
        return compiled

    def use_compiled(self) -> None:
        """Compile the loop, and run it in calls from now on."""
        self._used = self.compile()

    def use_numpy(self) -> None:
        """Run the numpy form in calls from now on."""
        self._used = self.numpy


def kernel(*signatures: str, numpy: Callable[P, R]) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """Mark a loop that can be compiled.

    Args:
        signatures: numba's types of arguments and result, such as ``float64(float64[::1], int64)``.
        numpy: The same function in numpy.
    """

    def mark(loop: Callable[P, R]) -> Kernel[P, R]:
        made = Kernel(loop, signatures, numpy)
        _kernels.append(made)
        return made

    return mark


def helper(function: Callable[P, R]) -> Callable[P, R]:
    """Mark a small function that compiled loops call; it stays plain Python for other callers."""
    _helpers[function] = None
    return function


def is_available() -> bool:
    """Return whether numba is installed and the variable ``RCE_COMPILED`` does not turn it off.

    numba is not imported for that: it takes tens of megabytes, and most of a second.
    """
    if os.environ.get(COMPILED, "").lower() in _OFF:
        return False
    return find_spec("numba") is not None


def compile_kernels(kernels: Iterable[Kernel[..., Any]] | None = None) -> bool:
    """Compile these kernels now, by default all of the imported modules, and log one line.

    Without numba, or with ``RCE_COMPILED=no``, they go on with numpy, and the line says so.

    Returns:
        Whether the kernels are compiled.
    """
    chosen = list(_kernels if kernels is None else kernels)
    if not chosen:
        return False
    if not is_available():
        _log.info(
            "%d inner loops run in numpy; 'pip install rce[compiled]' makes them faster%s",
            len(chosen),
            f" ({COMPILED} turns them off)" if COMPILED in os.environ else "",
        )
        return False
    begin = perf_counter()
    _find_installed()
    for each in chosen:
        each.use_compiled()
    _log.info("%d inner loops compiled in %.1f s (numba)", len(chosen), perf_counter() - begin)
    return True


def load_kernels(kernels: Iterable[Kernel[..., Any]]) -> bool:
    """Use compiled loops as far as numba's cache on disk has them; stop at the first that it does not have.

    Returns:
        Whether it had all of them.
    """
    if not is_available():
        return False
    _find_installed()
    for each in kernels:
        each.use_compiled()
        if not each.was_cached:
            return False
    return True


def compile_for_all() -> bool:
    """Compile the kernels of all imported modules into :data:`INSTALLED`, for all processes of this machine.

    Returns:
        Whether they are compiled; False without numba.

    Raises:
        OSError: The folder cannot be written to.
    """
    INSTALLED.mkdir(exist_ok=True)
    return compile_kernels()


def copy_compiled(source: Path, target: Path) -> None:
    """Copy numba's files of one cache into another one, unless those there are as new.

    An index comes after the loops that it names, so that a process that reads meanwhile finds them.
    """
    files = [path for path in source.rglob("*") if path.suffix in (".nbc", ".nbi")]
    for path in sorted(files, key=lambda path: path.suffix):
        copy = target / path.relative_to(source)
        if copy.exists() and copy.stat().st_mtime >= path.stat().st_mtime:
            continue
        copy.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=copy.parent)
        os.close(handle)
        shutil.copy2(path, name)
        Path(name).replace(copy)


def _find_installed() -> None:
    """Have numba look where ``rce compile`` left its loops, if it did."""
    import numba

    config: Any = numba.config  # without types
    if not INSTALLED.is_dir() or str(INSTALLED) == config.CACHE_DIR:
        return
    if not config.CACHE_DIR and os.access(INSTALLED, os.W_OK):
        config.CACHE_DIR = str(INSTALLED)
        return
    folder = Path(config.CACHE_DIR or Path.home() / ".cache" / "rce" / "compiled")
    try:
        copy_compiled(INSTALLED, folder)
    except OSError as error:
        _log.info("cannot copy compiled loops to %s, they are compiled anew: %s", folder, error)
    else:
        config.CACHE_DIR = str(folder)


def _jit(function: Callable[..., Any], signatures: list[str] | None) -> Any:
    """Compile a function with the helpers that it calls, from numba's cache on disk if it has one."""
    import numba

    assert isinstance(function, FunctionType)
    helpers = _helpers_of(function)
    names = {name: _compiled_helper(value) for name, value in helpers.items()}
    loop = function
    if names:
        loop = FunctionType(
            function.__code__, {**function.__globals__, **names}, function.__name__, function.__defaults__
        )
        loop.__module__ = function.__module__
        # numba's cache looks at the loop's own file only: another helper is another name there.
        loop.__qualname__ = f"{function.__qualname__}_{_digest(helpers.values())}"
    try:
        return numba.njit(signatures, cache=True, nogil=True)(loop) if signatures else numba.njit(loop)
    except RuntimeError as error:  # no folder can be written to for the cache
        if "cannot cache" not in str(error):
            raise
        return numba.njit(signatures, nogil=True)(loop)


def _compiled_helper(function: FunctionType) -> Any:
    if _helpers[function] is None:
        _helpers[function] = _jit(function, None)
    return _helpers[function]


def _helpers_of(function: FunctionType) -> dict[str, FunctionType]:
    """Return the helpers that a function calls, by the name that it calls them."""
    return {
        name: value
        for name in function.__code__.co_names
        if isinstance(value := function.__globals__.get(name), FunctionType) and value in _helpers
    }


def _digest(helpers: Iterable[FunctionType]) -> str:
    """Return a text that is another one if a helper, or what it calls or reads, is another one."""
    content = hashlib.sha256()
    waiting, seen = list(helpers), set[FunctionType]()
    while waiting:
        function = waiting.pop()
        if function in seen:
            continue
        seen.add(function)
        code, called = function.__code__, _helpers_of(function)
        read = [(name, function.__globals__.get(name)) for name in code.co_names if name not in called]
        constants = [(name, value) for name, value in read if isinstance(value, (bool, int, float, tuple))]
        content.update(repr((code.co_name, code.co_code, code.co_consts, code.co_names, constants)).encode())
        waiting += called.values()
    return content.hexdigest()[:16]
