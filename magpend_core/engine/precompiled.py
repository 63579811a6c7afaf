"""Compile the shared functions (parts) of an engine, and cache their code for other engines and processes.

numba infers the types of every function and translates it before LLVM sees it; this takes nine tenths of the time to
compile an engine. But most functions of an engine contain no equations of the system. Here such a function, a
*part*, is compiled once, to LLVM code that does not depend on the system:

- Another part that it calls is only declared. The function is chosen when an engine is linked.
- A size of the system, such as the number of its states, has a name but no value (see `linking`).

So for a new system only its own equations are compiled, and linked to parts from the cache.

Read in this order: `PartDispatcher` (a function that only compiled functions call), `linking.PartLibrary`
(its LLVM code), `PartCache` (its code on disk), `linking.EntryLibrary` (an engine's machine code).
"""

from __future__ import annotations

import contextlib
import hashlib
import pickle
from collections.abc import Callable, Iterator, Mapping
from itertools import count
from typing import Any
from weakref import WeakKeyDictionary

import llvmlite.binding as llvm
import numba
from numba.core import ir as numba_ir
from numba.core.compiler import CompilerBase, DefaultPassBuilder, compile_result
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import FunctionPass, PassManager, register_pass
from numba.core.ir_utils import build_definitions
from numba.core.registry import CPUDispatcher
from numba.core.typed_passes import (
    IRLegalization,
    NativeLowering,
    NoPythonBackend,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.untyped_passes import (
    DeadBranchPrune,
    FixupArgs,
    GenericRewrites,
    IRProcessing,
    ReconstructSSA,
    RewriteSemanticConstants,
    TranslateByteCode,
)

from magpend_core.compilation import compiling
from magpend_core.engine.code_cache import PartFolder, say
from magpend_core.engine.digests import lookups, reached
from magpend_core.engine.linking import EntryLibrary, PartLibrary


@register_pass(mutates_CFG=False, analysis_only=False)
class _NameFields(FunctionPass):
    """Compiler pass that replaces each field access of a global named tuple (such as ``ROWS.state``) by its integer.

    numba would put the whole tuple into the code as a constant wherever a field is read.
    """

    _name = "magpend_name_fields"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        found = [block for block in state.func_ir.blocks.values() if _name_fields(block)]
        if found:
            # update numba's table of definitions after the change
            state.func_ir._definitions = build_definitions(state.func_ir.blocks)
        return bool(found)


def _name_fields(block: Any) -> bool:
    tuples: dict[str, Any] = {}
    body = []
    for statement in block.body:
        value = getattr(statement, "value", None)
        if isinstance(value, numba_ir.Global | numba_ir.FreeVar) and _has_integers(value.value):
            tuples[statement.target.name] = statement
            continue
        if isinstance(value, numba_ir.Expr) and value.op == "getattr" and value.value.name in tuples:
            whole = tuples[value.value.name].value
            number = getattr(whole.value, value.attr)
            statement.value = numba_ir.Global(f"{whole.name}.{value.attr}", number, value.loc)
        else:
            # the tuple is used in another way here: put its definition back
            names = {v.name for v in statement.list_vars()}
            body += [tuples.pop(name) for name in names & set(tuples)]
        body.append(statement)
    changed = len(body) != len(block.body)
    block.body = body
    return changed


def _has_integers(value: Any) -> bool:
    return isinstance(value, tuple) and hasattr(value, "_fields") and all(type(x) is int for x in value)


@register_pass(mutates_CFG=False, analysis_only=False)
class _GiveEntryLibrary(FunctionPass):
    _name = "magpend_entry_library"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Give an entry function its code library before numba does, and allow its machine code to be cached."""
        state.library = EntryLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return True


@register_pass(mutates_CFG=False, analysis_only=False)
class _GivePartLibrary(FunctionPass):
    _name = "magpend_part_library"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Give a part its code library, and a symbol that is the same in all processes."""
        dispatcher = _COMPILED_NOW[-1]
        state.library = PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.dispatcher = dispatcher
        state.func_id.unique_id = dispatcher.number
        return True


class EntryCompiler(CompilerBase):
    """Numba compiler of an engine's entry function, with products fused by magpend's own rule (see `fusing`)."""

    _gives: type[FunctionPass] = _GiveEntryLibrary

    def compile_extra(self, func: Any) -> Any:
        """Compile an engine with its parts, and report begin and end of the compilation to a listener if there is
        one.
        """
        with compiling():
            return super().compile_extra(func)

    def define_pipelines(self) -> list[Any]:
        """Return numba's standard compiler passes and two of magpend's: one replaces named-tuple fields, one sets the
        code library.
        """
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_NameFields, IRProcessing)
        passes.add_pass_after(self._gives, NopythonTypeInference)
        passes.finalize()
        return [passes]


class PartCompiler(EntryCompiler):
    """Numba compiler of engine parts, without the passes that inline, rewrite or annotate code."""

    _passes = (
        TranslateByteCode,
        FixupArgs,
        IRProcessing,
        _NameFields,
        RewriteSemanticConstants,
        DeadBranchPrune,
        GenericRewrites,
        ReconstructSSA,
        DeadBranchPrune,
        NopythonTypeInference,
        _GivePartLibrary,
        PreLowerStripPhis,
        IRLegalization,
        NativeLowering,
        NoPythonBackend,
    )

    def define_pipelines(self) -> list[Any]:
        """Return the compiler passes for an engine part."""
        passes = PassManager("magpend_part")
        for step in self._passes:
            passes.add_pass(step, step.__name__)
        passes.finalize()
        return [passes]


_COMPILED_NOW: list[Any] = []
"""Stack of the parts being compiled (under numba's lock): each has been interrupted by the compilation of the next."""


class PartDispatcher(CPUDispatcher):
    """Numba dispatcher of an engine part (a function called from compiled code). For calls from Python it compiles a
    copy.

    Parameters
    ----------
    function
        A plain function.
    options
        Options of numba.
    sizes
        Values of the placeholders in the function, by name.
    identity
        Function that returns a digest of everything that the code depends on, except called functions and sizes; None
        if the digest is not known. The code is then not cached.
    folder
        Folder of the cached code; None to cache it only in this process.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        options: Mapping[str, Any],
        sizes: Mapping[str, int],
        identity: Callable[[], str | None],
        folder: PartFolder | None,
    ) -> None:
        settings = {"nopython": True, "boundscheck": None, **options}
        super().__init__(py_func=function, targetoptions=settings, pipeline_class=PartCompiler)
        self.sizes, self._identify, self._identified = sizes, identity, False
        self._key: str | None = None
        self._options = options
        self._copy: Any = None
        self._cache = PartCache(self, folder)

    @property
    def key(self) -> str | None:
        """Cache key of the code; None if the code is not cached."""
        if not self._identified:
            self._key, self._identified = self._identify(), True
        return self._key

    @property
    def number(self) -> int:
        """Number that makes the symbol of this part in compiled code unique."""
        return int(self.key[:14], 16) if self.key else next(_UNKEPT)

    def compile(self, sig: Any) -> Any:
        """Compile this part for a signature, or load its code from the cache."""
        with global_compiler_lock, self._cache.making(sig):
            _COMPILED_NOW.append(self)
            try:
                return super().compile(sig)
            finally:
                _COMPILED_NOW.pop()

    def add_overload(self, cres: Any) -> None:
        """Register the compiled code of one signature, without the wrapper that lets Python call it."""
        self.overloads[tuple(cres.signature.args)] = cres
        cres.library.symbol = cres.fndesc.mangled_name
        _OWNERS[cres.library] = tuple(cres.signature.args)

    def _compile_for_args(self, *args: Any, **kws: Any) -> Any:
        if self._copy is None:
            options = {name: value for name, value in self._options.items() if name != "no_cpython_wrapper"}
            self._copy = numba.njit(pipeline_class=EntryCompiler, **options)(self.py_func)
        return self._copy


_UNKEPT = count(1)
_OWNERS: WeakKeyDictionary[Any, tuple[Any, ...]] = WeakKeyDictionary()
"""Argument types of each compiled part, by its code library."""


# ---- cached code ---------------------------------------------------------------------------------------

_MEMORY: dict[str, bytes] = {}
"""Cached records of this process, by name."""


class PartCache:
    """Cache of one engine part (a function): its LLVM code, and the functions that it calls with their argument
    types.
    """

    def __init__(self, dispatcher: PartDispatcher, folder: PartFolder | None) -> None:
        self._dispatcher, self._folder = dispatcher, folder
        self.cache_path = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the cached code for a signature, or None if the cache has none."""
        return next(filter(None, (self._rebuilt(content, target_context) for content in self._records(sig))), None)

    def _records(self, sig: Any) -> Iterator[Any]:
        """Yield the cached records for a signature. They differ in the types that the functions return which this part
        calls: tuples, with an entry per state of a system.
        """
        for number in count():
            name = self._name(sig, number)
            record = None if name is None else self._record(name)
            if name is None or record is None:
                return
            try:
                whose, *content = pickle.loads(record)
            except Exception as error:
                # intact but unreadable: written by another version of Python than the cache key says
                say(f"a compiled part of a kernel, {name}, cannot be used ({error!r}); it is compiled again.")
                return
            if whose != name:
                return
            _MEMORY[name] = record
            yield content

    def _record(self, name: str) -> bytes | None:
        record = _MEMORY.get(name)
        return record if record is not None or self._folder is None else self._folder.read(name)

    def making(self, sig: Any) -> contextlib.AbstractContextManager[None]:
        """Return a context in which no other process compiles this part for a signature, if it has yet to be read."""
        name = self._name(sig)
        if self._folder is None or name is None or name in _MEMORY:
            return contextlib.nullcontext()
        return self._folder.making(name)

    def save_overload(self, sig: Any, cres: Any) -> None:
        """Write the code compiled for a signature to the cache, if this part has a cache key."""
        name = self._name(sig, sum(1 for _ in self._records(sig)))
        callees = self._callees(cres.library)
        if name is None or callees is None:
            return
        fndesc = cres.fndesc
        fndesc.typemap = fndesc.calltypes = None
        code = cres.library._final_module.as_bitcode()
        try:
            record = pickle.dumps((name, code, fndesc, cres.signature, callees))
        except Exception:  # a type that cannot be pickled
            return
        _MEMORY[name] = record
        if self._folder is not None:
            self._folder.write(name, record)

    def _name(self, sig: Any, number: int = 0) -> str | None:
        if self._dispatcher.key is None:
            return None
        text = f"{self._dispatcher.key} {tuple(getattr(sig, 'args', sig))!r} {number}"
        return f"{self._dispatcher.py_func.__name__[:40]}-{hashlib.sha256(text.encode()).hexdigest()[:24]}"

    def _callees(self, library: PartLibrary) -> list[Any] | None:
        """Return the engine parts that a function calls, each with its dotted name in the function's source. None if it
        calls anything else.
        """
        source = self._dispatcher.py_func
        paths = {id(reached(source, path)): path for path in lookups(source.__code__)}
        declared = {function.name for function in library._final_module.functions}
        rows = []
        for callee in dict.fromkeys(library._linking_libraries):
            if callee not in _OWNERS or id(callee.dispatcher) not in paths:
                return None
            if callee.symbol not in declared:  # LLVM removed the call, as it is never reached
                continue
            args = _OWNERS[callee]
            returns = callee.dispatcher.overloads[args].signature.return_type
            rows.append((paths[id(callee.dispatcher)], args, callee.symbol, returns))
        # two callees with equal code share a symbol here, but perhaps not in another system: do not cache this part
        return rows if len({row[2] for row in rows}) == len(rows) else None

    def _rebuilt(self, record: Any, target_context: Any) -> Any:
        code, fndesc, signature, callees = record
        library = PartLibrary(target_context.codegen(), fndesc.qualname)
        library.dispatcher = self._dispatcher
        found = []
        for path, args, symbol, returns in callees:
            callee = reached(self._dispatcher.py_func, path)
            callee.compile(args)
            compiled = callee.overloads[args]
            if compiled.signature.return_type != returns:
                return None
            library.add_linking_library(compiled.library)
            found.append((symbol, compiled.library.symbol))
        module = llvm.parse_bitcode(code)
        declared = [(module.get_function(symbol), own) for symbol, own in found]
        if len({symbol for _, symbol in declared}) < len(declared):
            return None
        # clear all names first, since a new name may be the old name of another function
        for function, _ in declared:
            function.name = ""
        for function, symbol in declared:
            function.name = symbol
        library._final_module = module
        library.finalize()
        return compile_result(
            typing_context=target_context.typing_context,
            target_context=target_context,
            entry_point=_Key(),
            library=library,
            signature=signature,
            objectmode=False,
            lifted=(),
            fndesc=fndesc,
            reload_init=(),
        )


class _Key:
    """Dummy for the entry point from Python, which cached code lacks; numba uses it as a dictionary key."""
