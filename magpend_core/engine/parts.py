"""Compile the parts of an engine, and keep their code for other engines and other processes.

numba types and lowers every function before LLVM sees it; this is nine tenths of the time that an engine
takes to compile. Most functions of an engine know no equations. Here such a function, a *part*, is compiled
once, to LLVM code in which nothing of a system is left:

- Another part that it calls is a declaration. Which function that is, is decided when an engine is linked.
- A size of the system, such as the number of its states, is a load from a constant that has a name and no
  value (see `sizes_as_loads`). The engine gives the values, and LLVM then folds them as if they had been
  written in the source.

So a new system compiles its own equations alone, and links them to parts from the cache.

Read in this order: `PartDispatcher` (a function that only compiled functions call), `PartLibrary` (its LLVM
code), `PartCache` (its code on disk), `EntryLibrary` (links an engine and makes machine code of it).
"""

from __future__ import annotations

import hashlib
import pickle
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from itertools import count
from typing import Any
from weakref import WeakKeyDictionary

import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils
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

from magpend_core.engine.digests import lookups, reached
from magpend_core.engine.fused import FusedLibrary, fuse_products
from magpend_core.engine.kept import PartFolder, say

_PLACEHOLDER = 0x6D61_6770_0000_0000
"""Placeholders are integers from here on; no template contains numbers of this size."""
_PLACEHOLDER_BYTES = "pgam" if sys.byteorder == "little" else "magp"
"""What tells a placeholder among the bytes of an array."""
_ARRAY = re.compile(r'(?m)^((@"\.const\.array\.data[^"]*") = internal constant \[8 x i8\] c"([^"]*)".*$)')
_NAMES: dict[str, int] = {}
_SYMBOL = "magpend.size."


def placeholder(name: str) -> int:
    """Return the integer that stands for a size of the system while a part is compiled."""
    return _NAMES.setdefault(name, _PLACEHOLDER + len(_NAMES))


class PartLibrary(FusedLibrary):
    """LLVM code of one part: neither linked to what it calls, nor machine code."""

    dispatcher: Any = None
    symbol = ""
    _whole: Any = None

    @property
    def codegen(self) -> Any:
        """The code generator."""
        return _NoMachineCode(self._codegen)

    def add_ir_module(self, ir_module: Any) -> None:
        """Add the LLVM code of the function."""
        fuse_products(ir_module)
        sizes_as_loads(ir_module)
        text = _arrays_by_name(cgutils.normalize_ir_text(str(ir_module)))
        _check_none_left(text)
        module = llvm.parse_assembly(text)
        module.name = ir_module.name
        module.verify()
        self.add_llvm_module(module)

    def finalize(self) -> None:
        """Take in what is no part, such as numba's ``max``; the engine's library links the rest."""
        own = _defined(self._final_module)
        for library in dict.fromkeys(self._linking_libraries):
            # the other library that is no part counts references, of which there are none here
            if not isinstance(library, PartLibrary) and library.name != "nrt":
                self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        _hide_others(self._final_module, own)
        self._linking_libraries = [x for x in self._linking_libraries if isinstance(x, PartLibrary)]
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0: there is no machine code."""
        self._ensure_finalized()
        return 0

    def own_module(self) -> Any:
        """Return the code of this part alone."""
        return super()._get_module_for_linking()

    def _get_module_for_linking(self) -> Any:
        """Return the code with all that it needs, for a function that numba compiles in its own way."""
        if self._whole is None:
            self._whole = self.own_module().clone()
            _link(self._whole, self)
            _hide_others(self._whole, _defined(self._final_module))
        return self._whole


class _NoMachineCode:
    """Stands for the code generator where numba would look for machine code."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, env_name: str, env: Any) -> None:
        """Do nothing: without machine code nothing can be told to an environment."""


class EntryLibrary(FusedLibrary):
    """Machine code of an engine: its entry, linked to all parts that it reaches."""

    def finalize(self) -> None:
        """Link the parts, give the sizes their values, optimise, and make machine code."""
        own = _defined(self._final_module)
        _link(self._final_module, self)
        # Parts of two engines have the same names, and other contents. The JIT would take the first for both.
        _hide_others(self._final_module, own)
        self._linking_libraries = []
        super().finalize()

    def _optimize_functions(self, ll_module: Any) -> None:
        """Leave it to the module's optimisation, which sees everything."""

    def _optimize_final_module(self) -> None:
        # Lanes are vectors already, and loops over states are short. numba's two rounds at level 3 with a
        # search for vectors take three times as long, and gain nothing (`tests/bench/kernel.py`).
        options = {"opt": 1, "loop_vectorize": False, "slp_vectorize": False}
        passes, builder = self._codegen._module_pass_manager(**options)
        passes.run(self._final_module, builder)


def _defined(module: Any) -> set[str]:
    return {function.name for function in module.functions if not function.is_declaration}


def _hide_others(module: Any, own: set[str]) -> None:
    """Make local to a module the functions that are not its own, and the sizes."""
    for value in (*module.functions, *module.global_variables):
        kind = value.is_function or value.name.startswith(_SYMBOL)
        if kind and not value.is_declaration and value.name not in own:
            value.linkage = "internal"


def _link(module: Any, library: Any) -> None:
    """Link to a module the libraries that one reaches, and the sizes that these are of."""
    sizes: dict[str, Any] = dict(library.dispatcher.sizes) if isinstance(library, PartLibrary) else {}
    for reached_one in _reached_libraries(library):
        if isinstance(reached_one, PartLibrary):
            _unite(sizes, reached_one.dispatcher.sizes)
            module.link_in(reached_one.own_module(), preserve=True)
        else:
            module.link_in(reached_one._get_module_for_linking(), preserve=True)
        library._reload_init.update(reached_one._reload_init)
    if sizes:
        module.link_in(llvm.parse_assembly(_definitions(sizes)))


def _unite(sizes: dict[str, Any], others: Mapping[str, Any]) -> None:
    for name, value in others.items():
        if not np.array_equal(sizes.setdefault(name, value), value):
            raise RuntimeError(f"parts of one engine disagree in {name}: {sizes[name]} and {value}.")


def _reached_libraries(library: Any) -> Iterator[Any]:
    """Yield the libraries that one links to, and those that its parts link to, each once."""
    seen, waiting = {library}, list(library._linking_libraries)
    while waiting:
        found = waiting.pop(0)
        if found not in seen:
            seen.add(found)
            yield found
            if isinstance(found, PartLibrary):
                waiting += found._linking_libraries


def _definitions(sizes: Mapping[str, Any]) -> str:
    """Return the sizes as LLVM's constants: integers, and arrays of float64 or int64 by their bits."""
    lines = []
    for name, value in sorted(sizes.items()):
        if isinstance(value, int):
            lines.append(f'@"{_SYMBOL}{name}" = constant i64 {value}')
        else:
            bits = ", ".join(f"i64 {x}" for x in np.array(value).view(np.int64))
            lines.append(f'@"{_SYMBOL}{name}" = constant [{len(value)} x i64] [{bits}], align 8')
    return "\n".join(lines)


def placeholder_of_array(name: str, array: np.ndarray) -> np.ndarray:
    """Return the array that stands for one of the system's, of float64 or int64."""
    return np.array([placeholder(name)]).view(array.dtype)


def sizes_as_loads(module: ir.Module) -> None:
    """Replace placeholders in a module by loads from constants without a value."""
    names = {value: name for name, value in _NAMES.items()}
    for function in module.functions:
        if function.blocks:
            _load_sizes(module, function, names)


def _arrays_by_name(text: str) -> str:
    """Replace arrays that are placeholders by constants without a value, as `sizes_as_loads` does."""
    names = {number: name for name, number in _NAMES.items()}
    used: set[str] = set()
    for definition, symbol, content in _ARRAY.findall(text):
        raw = re.sub(r"\\(..)", lambda found: chr(int(found[1], 16)), content).encode("latin-1")
        name = names.get(int.from_bytes(raw, sys.byteorder)) if len(raw) == 8 else None
        if name is not None:
            used.add(name)
            text = text.replace(definition, "").replace(symbol, f'@"{_SYMBOL}{name}"')
    declared = [f'@"{_SYMBOL}{name}" = external constant [8 x i8]\n' for name in sorted(used)]
    return text + "".join(declared)


def _check_none_left(text: str) -> None:
    left = [name for name, number in _NAMES.items() if str(number) in text]
    if left or _PLACEHOLDER_BYTES in text:
        what = ", ".join(left) or "an array"
        raise RuntimeError(f"a part of an engine has {what} in a constant: mend `sizes_as_loads`.")


def _load_sizes(module: ir.Module, function: ir.Function, names: Mapping[int, str]) -> None:
    loads: dict[str, Any] = {}

    def load(constant: Any) -> Any:
        name = names[constant.constant]
        if name not in loads:
            symbol = _SYMBOL + name
            known = module.globals.get(symbol)
            if known is None:
                known = ir.GlobalVariable(module, ir.IntType(64), symbol)
                known.global_constant = True
            # at the function's begin, where it comes before each use
            builder = ir.IRBuilder(function.entry_basic_block)
            builder.position_at_start(function.entry_basic_block)
            loads[name] = builder.load(known)
        return loads[name]

    for block in function.blocks:
        for instruction in list(block.instructions):
            for operand in {x for x in instruction.operands if _is_placeholder(x, names)}:
                instruction.replace_usage(operand, load(operand))


def _is_placeholder(value: Any, names: Mapping[int, str]) -> bool:
    constant = getattr(value, "constant", None)
    return isinstance(value, ir.Constant) and isinstance(constant, int) and constant in names


# ---- numba's compiler, with these libraries ------------------------------------------------------------


@register_pass(mutates_CFG=False, analysis_only=False)
class _NameFields(FunctionPass):
    """Replaces a field of a named tuple of integers by that integer.

    numba would make a constant of the whole tuple at each place where one of its fields is read.
    """

    _name = "magpend_name_fields"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Look for fields of global named tuples."""
        found = [block for block in state.func_ir.blocks.values() if _name_fields(block)]
        if found:
            # where they are defined has changed
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
            # used in another way: as it was
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
        """Give a function its library before numba does, and let its machine code be kept."""
        state.library = EntryLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return True


@register_pass(mutates_CFG=False, analysis_only=False)
class _GivePartLibrary(FunctionPass):
    _name = "magpend_part_library"

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Give a part its library, and a number by which its name is the same in all processes."""
        dispatcher = _COMPILED_NOW[-1]
        state.library = PartLibrary(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.dispatcher = dispatcher
        state.func_id.unique_id = dispatcher.number
        return True


class EntryCompiler(CompilerBase):
    """numba's compiler of functions, with products fused by our rule (see `fused`)."""

    _gives: type[FunctionPass] = _GiveEntryLibrary

    def define_pipelines(self) -> list[Any]:
        """Return numba's own passes with two more."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(_NameFields, IRProcessing)
        passes.add_pass_after(self._gives, NopythonTypeInference)
        passes.finalize()
        return [passes]


class PartCompiler(EntryCompiler):
    """The same for parts: without the passes that inline, rewrite or annotate what an engine does not use."""

    _passes = (
        TranslateByteCode, FixupArgs, IRProcessing, _NameFields, RewriteSemanticConstants, DeadBranchPrune,
        GenericRewrites, ReconstructSSA, DeadBranchPrune, NopythonTypeInference, _GivePartLibrary,
        PreLowerStripPhis, IRLegalization, NativeLowering, NoPythonBackend,
    )  # fmt: skip

    def define_pipelines(self) -> list[Any]:
        """Return the passes."""
        passes = PassManager("magpend_part")
        for step in self._passes:
            passes.add_pass(step, step.__name__)
        passes.finalize()
        return [passes]


_COMPILED_NOW: list[Any] = []
"""Parts that are being compiled, under numba's lock; the last is in progress."""


class PartDispatcher(CPUDispatcher):
    """A function that compiled functions call. A call from Python compiles a copy of it first.

    Parameters
    ----------
    function
        A plain function.
    options
        numba's.
    sizes
        Values of the placeholders that it was bound to.
    identity
        Returns a digest of all that its code depends on but the functions that it calls and the sizes; None
        if that cannot be found out. Its code is then not kept.
    folder
        Where code is kept; None to keep it in this process alone.
    """

    def __init__(
        self, function: Callable[..., Any], options: Mapping[str, Any], sizes: Mapping[str, int],
        identity: Callable[[], str | None], folder: PartFolder | None,
    ) -> None:  # fmt: skip
        settings = {"nopython": True, "boundscheck": None, **options}
        super().__init__(py_func=function, targetoptions=settings, pipeline_class=PartCompiler)
        self.sizes, self._identify, self._identified = sizes, identity, False
        self._key: str | None = None
        self._options = options
        self._copy: Any = None
        self._cache = PartCache(self, folder)

    @property
    def key(self) -> str | None:
        """What the code is kept under; None if it is not."""
        if not self._identified:
            self._key, self._identified = self._identify(), True
        return self._key

    @property
    def number(self) -> int:
        """A number that no other part's symbol has."""
        return int(self.key[:14], 16) if self.key else next(_UNKEPT)

    def compile(self, sig: Any) -> Any:
        """Compile for a signature, or take the code from the cache."""
        with global_compiler_lock:
            _COMPILED_NOW.append(self)
            try:
                return super().compile(sig)
            finally:
                _COMPILED_NOW.pop()

    def add_overload(self, cres: Any) -> None:
        """Take note of what was compiled, which Python cannot call."""
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
"""Of each part's library the argument types."""


# ---- code that is kept ---------------------------------------------------------------------------------

_MEMORY: dict[str, bytes] = {}
"""Records of this process."""


class PartCache:
    """Records of one part: its LLVM code, and which functions it calls with which types."""

    def __init__(self, dispatcher: PartDispatcher, folder: PartFolder | None) -> None:
        self._dispatcher, self._folder = dispatcher, folder
        self.cache_path = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what was compiled for a signature, None if nothing fits."""
        name = self._name(sig)
        if name is None:
            return None
        record = _MEMORY.get(name)
        if record is None and self._folder is not None:
            record = self._folder.read(name)
        if record is None:
            return None
        try:
            whose, *content = pickle.loads(record)
        except Exception as error:
            # what is whole and cannot be read was written by another Python than it says
            say(f"a compiled part of a kernel, {name}, cannot be used ({error!r}); it is compiled again.")
            return None
        found = self._rebuilt(content, target_context) if whose == name else None
        if found is not None:
            _MEMORY[name] = record
        return found

    def save_overload(self, sig: Any, cres: Any) -> None:
        """Keep what was compiled, if it can be found again."""
        name = self._name(sig)
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

    def _name(self, sig: Any) -> str | None:
        if self._dispatcher.key is None:
            return None
        text = f"{self._dispatcher.key} {tuple(getattr(sig, 'args', sig))!r}"
        return f"{self._dispatcher.py_func.__name__[:40]}-{hashlib.sha256(text.encode()).hexdigest()[:24]}"

    def _callees(self, library: PartLibrary) -> list[Any] | None:
        """Return where the function finds each part that it calls; None if it calls something else."""
        source = self._dispatcher.py_func
        paths = {id(reached(source, path)): path for path in lookups(source.__code__)}
        declared = {function.name for function in library._final_module.functions}
        rows = []
        for callee in dict.fromkeys(library._linking_libraries):
            if callee not in _OWNERS or id(callee.dispatcher) not in paths:
                return None
            if callee.symbol not in declared:  # LLVM has seen that the call is never reached
                continue
            args = _OWNERS[callee]
            returns = callee.dispatcher.overloads[args].signature.return_type
            rows.append((paths[id(callee.dispatcher)], args, callee.symbol, returns))
        # two functions of one content have one symbol; those of another system need not
        return rows if len({row[2] for row in rows}) == len(rows) else None

    def _rebuilt(self, record: Any, target_context: Any) -> Any:
        code, fndesc, signature, callees = record
        library = PartLibrary(target_context.codegen(), fndesc.qualname)
        library.dispatcher = self._dispatcher
        module = llvm.parse_bitcode(code)
        declared = []
        for path, args, symbol, returns in callees:
            callee = reached(self._dispatcher.py_func, path)
            callee.compile(args)
            compiled = callee.overloads[args]
            if compiled.signature.return_type != returns:
                return None
            library.add_linking_library(compiled.library)
            declared.append((module.get_function(symbol), compiled.library.symbol))
        if len({symbol for _, symbol in declared}) < len(declared):
            return None
        # all lose their names before one takes another's
        for function, _ in declared:
            function.name = ""
        for function, symbol in declared:
            function.name = symbol
        library._final_module = module
        library.finalize()
        return compile_result(
            typing_context=target_context.typing_context, target_context=target_context,
            entry_point=_Key(), library=library, signature=signature, objectmode=False, lifted=(),
            fndesc=fndesc, reload_init=(),
        )  # fmt: skip


class _Key:
    """Stands for a function that Python cannot call; numba finds compiled code by it."""
