"""`njit` with a disk cache that processes share; a changed function or callee is recompiled."""

from __future__ import annotations

import os
import pickle
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any
from uuid import uuid4

import numba
import numpy as np
from numba.core import cgutils, types
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher
from numba.core.serialize import dumps
from numba.extending import intrinsic

from drake_teleop.common.errors import DrakeTeleopError

_CONSTANT_TYPES_HASHED_BY_REPR = (
    *(int, float, complex, str, bytes, slice, type(None), type(...)),
    *(np.dtype, np.generic),
)


def njit(*, omits_reference_counting: bool = False, **options: Any) -> Callable[[Any], Any]:
    """Return a decorator like `numba.njit`; with `cache=True` it stores the machine code on disk.

    `omits_reference_counting` gives faster code, but the function must create no arrays.
    """
    # Set in either case, because callees inherit unset options.
    options["_nrt"] = not omits_reference_counting

    def compile_function(function: FunctionType) -> Any:
        # No function is called from C; omitting the wrappers saves 4 % of the compile time.
        dispatcher = numba.njit(**options | {"cache": False, "no_cfunc_wrapper": True})(function)
        if options.get("cache") and isinstance(dispatcher, Dispatcher):
            with suppress(RuntimeError):  # no writable folder: each process compiles again
                dispatcher._cache = FunctionCache(function)
                folder = Path(dispatcher._cache.cache_path)
                dispatcher._cache._cache_file = _CacheFiles(folder, dispatcher)
        return dispatcher

    return compile_function


def make_call_at_address(arguments: tuple[types.Type, ...]) -> Any:
    """Return a compiled function of the address and arguments of machine code, which it calls."""

    @intrinsic
    def call(_typing_context: Any, _address: Any, *_arguments: Any) -> Any:
        def generate_code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            address, packed = values
            pairs = zip(cgutils.unpack_tuple(builder, packed), signature.args[1], strict=True)
            cast = [
                context.cast(builder, value, kind, expected)
                for (value, kind), expected in zip(pairs, arguments, strict=True)
            ]
            kind = context.call_conv.get_function_type(types.void, arguments).as_pointer()
            function = builder.inttoptr(address, kind)
            status, _ = context.call_conv.call_function(
                builder, function, types.void, arguments, cast
            )
            with cgutils.if_unlikely(builder, status.is_error):
                context.call_conv.return_status_propagate(builder, status)
            return context.get_dummy_value()

        return types.void(types.int64, types.StarArgTuple(_arguments)), generate_code

    call.__qualname__ = f"call_at{arguments}"  # part of the caller's fingerprint
    return call


def address_of_function(function: Dispatcher, arguments: tuple[types.Type, ...]) -> int:
    if not isinstance(function, Dispatcher):
        where = f"function {getattr(function, '__qualname__', function)}"
        remedy = "decorate it with @njit(cache=True) of drake_teleop.common.compiled"
        raise DrakeTeleopError("is not compiled", where=where, remedy=remedy)
    code = function.get_compile_result(types.void(*arguments))._asdict()
    return code["library"].get_pointer_to_function(code["fndesc"].llvm_func_name)


class _CacheFiles:
    def __init__(self, folder: Path, dispatcher: Dispatcher) -> None:
        function = dispatcher.py_func
        versions = f"{sys.implementation.cache_tag}.numba-{numba.__version__}"
        file = Path(function.__code__.co_filename).stem
        self._folder, self._dispatcher = folder, dispatcher
        self._prefix = f"{file}.{function.__qualname__}.{versions}-"

    def load(self, key: Any) -> Any:
        with (
            suppress(OSError, EOFError, pickle.UnpicklingError),
            self._cache_file_path(key).open("rb") as file,
        ):
            if not _is_trusted_file(os.fstat(file.fileno())):
                return None
            stored_key, code = pickle.loads(file.read())
            return code if stored_key == key else None

    def save(self, key: Any, code: Any) -> None:
        path = self._cache_file_path(key)
        temporary = path.with_suffix(f".{uuid4().hex}")
        try:
            temporary.touch(mode=0o644)  # not writable by others, with any umask
            temporary.write_bytes(dumps((key, code)))
            os.replace(temporary, path)
            self._remove_cache_files(self._prefix + fingerprint_of_code(self._dispatcher))
        except OSError:  # full disk: compile again next time
            with suppress(OSError):
                temporary.unlink(missing_ok=True)

    def flush(self) -> None:
        self._remove_cache_files()

    def _cache_file_path(self, key: Any) -> Path:
        this = sha256(str(key).encode()).hexdigest()[:16]
        return self._folder / f"{self._prefix}{fingerprint_of_code(self._dispatcher)}-{this}.nbc"

    def _remove_cache_files(self, kept_prefix: str | None = None) -> None:
        for path in self._folder.glob(f"{self._prefix}*.nbc"):
            if kept_prefix is None or not path.name.startswith(kept_prefix):
                path.unlink(missing_ok=True)


def _is_trusted_file(file_status: os.stat_result) -> bool:
    owners = {os.getuid(), 0, Path(__file__).stat().st_uid}
    return file_status.st_uid in owners and not file_status.st_mode & stat.S_IWOTH


def fingerprint_of_code(dispatcher: Dispatcher) -> str:
    found: set[Any] = {dispatcher}
    pending: list[Any] = [dispatcher]
    while pending:
        called = _text_for_fingerprint_and_callees(pending.pop())[1] - found
        found |= called
        pending.extend(called)
    texts = sorted(_text_for_fingerprint_and_callees(each)[0] for each in found)
    return sha256("\n".join(texts).encode()).hexdigest()[:16]


@cache
def _text_for_fingerprint_and_callees(compiled: Any) -> tuple[str, frozenset[Any]]:
    function = getattr(compiled, "py_func", compiled)
    constants = dict(_values_referenced_by(function))
    options = getattr(compiled, "targetoptions", {})
    text = (
        _qualified_name(compiled),
        _text_for_fingerprint(function.__code__),
        _text_for_fingerprint(function.__defaults__),
        sorted((name, str(option)) for name, option in options.items()),
        sorted((name, _text_for_fingerprint(value)) for name, value in constants.items()),
    )
    package = function.__module__.partition(".")[0]
    callees = (value for value in constants.values() if _is_callee(value, package))
    return repr(text), frozenset(callees)


def _is_callee(value: Any, package: str) -> bool:
    plain = isinstance(value, FunctionType) and value.__module__.partition(".")[0] == package
    return plain or isinstance(value, Dispatcher)


def _values_referenced_by(function: FunctionType) -> Iterator[tuple[str, Any]]:
    cells = function.__closure__ or ()
    for name, cell in zip(function.__code__.co_freevars, cells, strict=True):
        yield name, cell.cell_contents
    names = set(_names_referenced_by_code(function.__code__))
    package = function.__module__.partition(".")[0]
    scopes = [function.__globals__]
    for scope in scopes:
        for name in names & scope.keys():
            value = scope[name]
            yield f"{scope['__name__']}.{name}", value
            # For calls `module.function`; other packages change only with their version.
            ours = isinstance(value, ModuleType) and value.__name__.partition(".")[0] == package
            if ours and all(known is not vars(value) for known in scopes):
                scopes.append(vars(value))


def _names_referenced_by_code(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names_referenced_by_code(constant)


def _text_for_fingerprint(value: Any) -> str:
    if isinstance(value, CodeType):
        parts = [value.co_code, value.co_names, value.co_varnames, value.co_argcount]
        # Since Python 3.11 exception handlers are in a separate table.
        parts += [value.co_freevars, getattr(value, "co_exceptiontable", b"")]
        return repr((parts, _text_for_fingerprint(value.co_consts)))
    if isinstance(value, tuple):
        return f"{type(value).__name__}{[_text_for_fingerprint(each) for each in value]}"
    if isinstance(value, np.ndarray):
        return repr((value.dtype, value.shape, value.tobytes()))
    if isinstance(value, (Dispatcher, ModuleType)) or callable(value):
        return _qualified_name(value)
    if isinstance(value, _CONSTANT_TYPES_HASHED_BY_REPR):
        return repr(value)
    what = f"a cached compiled function uses {value!r}"
    raise TypeError(f"{what}, whose changes are not detected; pass this value as an argument")


def _qualified_name(value: Any) -> str:
    value = getattr(value, "py_func", value)
    named = getattr(value, "__qualname__", "") or value.__name__  # modules have no qualified name
    return f"{getattr(value, '__module__', '')}.{named}{getattr(value, '_fields', '')}"
