"""The engine that compiles the kernels: Taichi, or its fork Quadrants. No other module imports either of them.

The two have the same language and differ in limits, names and private interfaces. Everything in which they differ is
here: `ti` is the module of the engine in use, `engine()` describes it, and the functions below reach its private parts.
Taichi is used where it is installed, and Quadrants otherwise; the environment variable MODP_ENGINE chooses one of them.

The engine is loaded when `ti` is first accessed, so that importing this module takes no time.
"""

from __future__ import annotations

import atexit
import functools
import importlib
import os
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any

from fields.runtime import process

if TYPE_CHECKING:
    import taichi as ti  # noqa: TID251 (this is the one place)

__all__ = [
    "Engine",
    "EngineError",
    "compiled_kernel",
    "configuration",
    "dense_array",
    "engine",
    "error_class",
    "forget_arrays",
    "forget_unfinished",
    "lock",
    "owner_of_kernel",
    "part",
    "running_program",
    "start",
    "ti",
]

VARIABLE = "MODP_ENGINE"


class EngineError(RuntimeError):
    """No engine can be loaded. The message is one line that says what to install or to change."""


@dataclass(frozen=True)
class Engine:
    """Names and limits of an engine.

    Attributes:
        package: Name of its package and distribution.
        title: Its name in messages.
        prefix: Prefix of its environment variables.
        cache_suffix: Suffix of the files in its offline cache.
        switches: Environment variables that are set before it is loaded, unless they are set already.
        max_gaussians: Largest pool of Gaussians.
        max_gaussians_offline: The same for the offline mapper, whose Gaussians are larger.
        max_snodes: Number of SNodes of a process, which the engine does not check; None for no limit.
        max_sparse: Number of sparse SNodes of a process on the CPU, which the engine does not check; None for no limit.
        max_rasterizers: Number of sets of fields that `rasterize` may keep.
        program: Attribute of the runtime that holds the running program.
        compiled_kernels: Attribute of a kernel that holds its compiled instances.
        owner: Attribute of a bound kernel that holds its object.
        nested_arguments: Whether an argument's place is a tuple of indices instead of an index.
        source_readers: Modules that look up the sources of kernels, below the package.
        position_note: Module, class and method that describe the source line of an expression.
        slow_attributes: Whether the attributes of data-oriented objects are looked up in Python.
        saves_cache_on_reset: Whether the offline cache is written only when the engine is reset.
        parses_twice: Whether it parses a kernel a first time to find which fields of its dataclass arguments are used.
    """

    package: str
    title: str
    prefix: str
    cache_suffix: str
    switches: dict[str, str]
    max_gaussians: int
    max_gaussians_offline: int
    max_snodes: int | None
    max_sparse: int | None
    max_rasterizers: int
    program: str
    compiled_kernels: str
    owner: str
    nested_arguments: bool
    source_readers: tuple[str, ...]
    position_note: tuple[str, str, str]
    slow_attributes: bool
    saves_cache_on_reset: bool
    parses_twice: bool

    def __str__(self) -> str:
        return f"{self.title} {self.version}"

    @property
    def version(self) -> str:
        """Version of the installed package."""
        try:
            return version(self.package)
        except PackageNotFoundError:  # installed by another distribution
            return "of unknown version"

    def variable(self, option: str) -> str:
        """Return the environment variable that sets an option of the engine, for example `offline_cache_file_path`."""
        return self.prefix + option.upper()

    def checked_pool(self, count: int, most: int) -> int:
        """Return the size of a pool of Gaussians. Raises ValueError if it exceeds `most`, a limit of the engine."""
        if count > most:
            raise ValueError(f"{self.title} holds at most {most:,} Gaussians here; docs/platforms.md tells the limits")
        return count

    def place(self, index: int) -> Any:
        """Return the place of a kernel's argument as the engine's launch context takes it."""
        return (index,) if self.nested_arguments else index


TAICHI = Engine(
    package="taichi",
    title="Taichi",
    prefix="TI_",
    cache_suffix=".tic",
    # A library should not print a greeting, and a start should not ask a server for the latest version.
    switches={"ENABLE_TAICHI_HEADER_PRINT": "0", "TI_SKIP_VERSION_CHECK": "ON"},
    # Taichi 1.7.4 was seen to write beyond its memory once sparse fields exceed 1.7 GB (docs/method.md).
    max_gaussians=1_500_000,
    max_gaussians_offline=1_000_000,
    max_snodes=1024,
    # With 18, of two maps or a map and two renderers with Gaussians, memory was written over; with 16 it was not.
    max_sparse=16,
    max_rasterizers=2,  # with a third set of fields, the process crashed on the CPU
    program="prog",
    compiled_kernels="compiled_kernels",
    owner="_kernel_owner",
    nested_arguments=True,
    source_readers=("lang.kernel_impl",),
    position_note=("lang.ast.ast_transformer_utils", "ASTTransformerContext", "get_pos_info"),
    slow_attributes=True,
    saves_cache_on_reset=False,
    parses_twice=False,
)

# With this many Gaussians of degree 3, indices of their coefficients still fit in 32 bits.
INDEXED = 1 << 25

QUADRANTS = Engine(
    package="quadrants",
    title="Quadrants",
    prefix="QD_",
    cache_suffix=".qdc",
    switches={"ENABLE_QUADRANTS_HEADER_PRINT": "0"},
    max_gaussians=INDEXED,
    max_gaussians_offline=INDEXED,
    max_snodes=None,
    max_sparse=None,
    max_rasterizers=16,
    program="_prog",
    compiled_kernels="materialized_kernels",
    owner="instance",
    nested_arguments=False,
    source_readers=("lang.kernel_impl", "lang.kernel", "lang._func_base", "lang.ast.checkers"),
    position_note=("lang.ast.ast_transformer_utils", "ASTTransformerFuncContext", "memoized_get_pos_info"),
    slow_attributes=False,
    saves_cache_on_reset=True,
    parses_twice=True,
)

ENGINES = {known.package: known for known in (TAICHI, QUADRANTS)}


@functools.cache
def engine() -> Engine:
    """Return the engine in use, without loading it.

    Raises:
        EngineError: If MODP_ENGINE names no engine, or the engine is not installed.
    """
    asked = os.environ.get(VARIABLE, "")
    if not asked:
        for known in ENGINES.values():
            if find_spec(known.package) is not None:
                return known
        raise EngineError(
            "neither Taichi nor Quadrants is installed: pip install taichi==1.7.4 (Python 3.10 to 3.13) or "
            "pip install quadrants"
        )
    if asked not in ENGINES:
        raise EngineError(f"{VARIABLE}={asked} is no engine: set it to {' or '.join(ENGINES)}, or unset it")
    if find_spec(asked) is None:
        raise EngineError(f"{VARIABLE}={asked}, which is not installed: pip install {asked}, or unset {VARIABLE}")
    return ENGINES[asked]


@functools.cache
def _load() -> ModuleType:
    chosen = engine()
    if (narrow := process.why_too_narrow()) is not None:
        raise EngineError(narrow)
    for name, value in chosen.switches.items():
        os.environ.setdefault(name, value)
    process.provide_cache(chosen.package)
    try:
        module = importlib.import_module(chosen.package)
    except ImportError as error:
        raise EngineError(
            f"{chosen.title} cannot be loaded ({error}): install it anew, or set {VARIABLE} to another"
        ) from error
    if chosen.saves_cache_on_reset or process.notes:  # a temporary cache is removed after that
        atexit.register(module.reset)
    if chosen.slow_attributes:
        vars(module)["data_oriented"] = _data_oriented
    module.FieldsBuilder._finalize = _finalised_at_home(module.FieldsBuilder._finalize)
    return module


class _ClassKernel:
    """A `ti.kernel` method of a Taichi class, which binds itself to the object it is accessed on."""

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel
        kernel._is_staticmethod = False

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None:
            return self._kernel
        bound = part("lang.kernel_impl")._BoundedDifferentiableMethod(instance, self._kernel)
        bound.__name__ = self._kernel.__name__
        return bound


def _data_oriented(cls: type) -> type:
    """Replace Taichi's `data_oriented`: kernels are descriptors, and attributes are those of any class.

    Taichi 1.7.4 sends every access to an attribute through a function in Python, to find out whether it is a kernel. A
    view's step has 250 of them, which took the host 0.3 ms.
    """
    for name, value in list(vars(cls).items()):
        if getattr(value, "_is_classkernel", False):
            setattr(cls, name, _ClassKernel(value))
    cls._data_oriented = True  # pyright: ignore[reportAttributeAccessIssue]
    return cls


def __getattr__(name: str) -> Any:
    """Load the engine at the first access of `ti`, which is a plain attribute from then on."""
    if name != "ti":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()["ti"] = module = _load()
    return module


# ---- threads ---------------------------------------------------------------------------------------------------

# Kernels can be launched from any thread, but only one after the other.
lock = threading.RLock()
# LLVM lets only the thread that has started the engine add fields: one of its own, or that which has called `start`.
_home: ThreadPoolExecutor | None = None
_starter: threading.Thread | None = None


def start(arch: object, in_own_thread: bool, **options: Any) -> None:
    """Start the engine, which frees all fields.

    Args:
        arch: The backend, for example `ti.cpu`.
        in_own_thread: Let any thread make fields, not only the calling one.
        options: Options of `ti.init`.
    """
    global _home, _starter
    if _home is not None:
        _home.shutdown(wait=False)
    # Always a new one: in a forked process, the old thread does not exist.
    _home, _starter = (ThreadPoolExecutor(1, "engine"), None) if in_own_thread else (None, threading.current_thread())
    if _home is None:
        ti.init(arch=arch, **options)
    else:
        _home.submit(ti.init, arch=arch, **options).result()


def _finalised_at_home(finalise: Callable[..., Any]) -> Callable[..., Any]:
    """Make the method of a fields builder that adds its fields to the engine run in the right thread."""

    def finalised(*arguments: Any, **named: Any) -> Any:
        if _home is not None:
            return _home.submit(finalise, *arguments, **named).result()
        if configuration().arch == ti.cuda and _starter is not threading.current_thread():
            raise RuntimeError("on CUDA, make maps and renderers in the thread that called modp_ti.initialise()")
        return finalise(*arguments, **named)

    return finalised


def forget_unfinished() -> None:
    """Let go of the fields that were declared and not added to the engine, which would refuse any kernel."""
    runtime = part("lang.impl").get_runtime()
    runtime.unfinalized_fields_builder.clear()
    for fields in (runtime.global_vars, runtime.grad_vars, runtime.dual_vars, runtime.matrix_fields):
        fields.clear()


# ---- arrays ----------------------------------------------------------------------------------------------------

_arrays: weakref.WeakSet[Any] = weakref.WeakSet()


def dense_array(dtype: Any, shape: tuple[int, ...]) -> Any:
    """Return an array of zeros on the device, which kernels take as arguments. Its last reference frees it."""
    array = ti.ndarray(dtype, shape)
    _arrays.add(array)
    return array


def forget_arrays() -> None:
    """Let go of all arrays, just before the engine is started anew, which frees them.

    Taichi asks the running program to free an array by its address, where that program may have another one.
    """
    for array in list(_arrays):
        array.arr = None
    _arrays.clear()


# ---- private parts ---------------------------------------------------------------------------------------------


@functools.cache
def part(name: str) -> Any:
    """Return a module of the engine by its name below the package, for example `lang.impl`.

    `import` finds the module even where its package has a function of the same name, as with `lang.kernel`.
    """
    return importlib.import_module(f"{_load().__name__}.{name}")


def configuration() -> Any:
    """Return the configuration that the running engine was started with."""
    return part("lang.impl").current_cfg()


def running_program() -> Any:
    """Return the program that owns the current fields; None before the engine has been started."""
    return getattr(part("lang.impl").get_runtime(), engine().program)


def owner_of_kernel(kernel: Any) -> Any:
    """Return the object of a bound `ti.kernel` method."""
    return getattr(kernel, engine().owner)


def compiled_kernel(kernel: Any, arguments: tuple) -> tuple[Callable[[], Any], Any]:
    """Compile a kernel for arguments of these types.

    Args:
        kernel: The primal or adjoint kernel of a `ti.kernel` method.
        arguments: Its object, templates and arguments.

    Returns:
        A function that makes a launch context, and the compiled kernel that the program launches with it.
    """
    program = running_program()
    instance = getattr(kernel, engine().compiled_kernels)[kernel.ensure_compiled(*arguments)]
    compiled = program.compile_kernel(program.config(), program.get_device_caps(), instance)
    return instance.make_launch_context, getattr(compiled, "compiled_kernel_data", compiled)


def error_class(name: str) -> type[Exception]:
    """Return an exception of the engine by its name after the engine's, for example `CompilationError`."""
    return getattr(_load(), engine().title + name)
