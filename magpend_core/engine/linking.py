"""Link the precompiled functions (parts) of an engine as LLVM code, and set system sizes such as the number of states.

A *size* of a system, such as the number of its states, is a constant whose value the code of a part does not contain.
While numba compiles the part, a unique integer stands for it (`placeholder`). In the LLVM code this integer is
replaced by a load from a named constant (`sizes_as_loads`). The engine's library defines the constants, and LLVM then
optimises the code as if the numbers stood in the source.
"""

from __future__ import annotations

import re
import sys
import zlib
from collections.abc import Iterator, Mapping
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba.core import cgutils

from magpend_core.engine.fusing import FusedLibrary, fuse_products

_PLACEHOLDER = 0x6D61_6770_0000_0000
"""Placeholders are integers from here on; no template contains numbers of this size."""
_PLACEHOLDER_BYTES = "pgam" if sys.byteorder == "little" else "magp"
"""Bytes by which a placeholder is recognised in the LLVM text of an array."""
_ARRAY = re.compile(r'(?m)^((@"\.const\.array\.data[^"]*") = internal constant \[8 x i8\] c"([^"]*)".*$)')
_NAMES: dict[str, int] = {}
_SYMBOL = "magpend.size."


def placeholder(name: str) -> int:
    """Return the unique integer that stands for a system size (such as the number of states) while a part is
    compiled. It follows from the name, so that every process shares the cached part.
    """
    number = _PLACEHOLDER + zlib.crc32(name.encode())
    if any(other != name and known == number for other, known in _NAMES.items()):
        raise RuntimeError(f"the system size {name} has the placeholder of another one; rename it.")
    return _NAMES.setdefault(name, number)


class PartLibrary(FusedLibrary):
    """Code library of one part (a precompiled function of the engine) for numba: LLVM code, not yet machine code."""

    dispatcher: Any = None
    symbol = ""
    _whole: Any = None

    @property
    def codegen(self) -> Any:
        """Numba's code generator, wrapped so that numba looks for no machine code."""
        return _NoMachineCode(self._codegen)

    def add_ir_module(self, ir_module: Any) -> None:
        """Add the LLVM code of a function, with products fused and with system sizes read from named constants."""
        fuse_products(ir_module)
        sizes_as_loads(ir_module)
        text = _arrays_by_name(cgutils.normalize_ir_text(str(ir_module)))
        _check_none_left(text)
        module = llvm.parse_assembly(text)
        module.name = ir_module.name
        module.verify()
        self.add_llvm_module(module)

    def finalize(self) -> None:
        """Link numba's own libraries (such as that of ``max``) into this part. Other parts are linked later, into the
        engine's library.
        """
        own = _defined(self._final_module)
        for library in dict.fromkeys(self._linking_libraries):
            # "nrt" is numba's library for reference counts, which parts do not use
            if not isinstance(library, PartLibrary) and library.name != "nrt":
                self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        _hide_others(self._final_module, own)
        self._linking_libraries = [x for x in self._linking_libraries if isinstance(x, PartLibrary)]
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0 as the address of every function, because a part has no machine code."""
        self._ensure_finalized()
        return 0

    def own_module(self) -> Any:
        """Return the LLVM module of this part alone, without its dependencies."""
        return super()._get_module_for_linking()

    def _get_module_for_linking(self) -> Any:
        """Return the LLVM module linked with all its dependencies, for functions that numba's own compiler compiles."""
        if self._whole is None:
            self._whole = self.own_module().clone()
            _link(self._whole, self)
            _hide_others(self._whole, _defined(self._final_module))
        return self._whole


class _NoMachineCode:
    """Wrapper of numba's code generator for LLVM code that is not machine code yet. It forwards all calls but
    `set_env`.
    """

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, env_name: str, env: Any) -> None:
        """Do nothing: code that is not machine code yet has no environment to set."""


class EntryLibrary(FusedLibrary):
    """Code library of one engine for numba: its entry function, linked to all precompiled functions (parts) that it
    calls.
    """

    def finalize(self) -> None:
        """Link the precompiled functions (parts), define the size constants, optimise, and generate machine code."""
        own = _defined(self._final_module)
        _link(self._final_module, self)
        # Parts of two engines have equal names but different code. If they were public, the JIT would use the first
        # part for both engines.
        _hide_others(self._final_module, own)
        self._linking_libraries = []
        super().finalize()

    def _optimize_functions(self, ll_module: Any) -> None:
        """Skip the optimisation of single functions: the later pass over the whole module does it all."""

    def _optimize_final_module(self) -> None:
        # The code consists of vector operations already, and loops over states are short. numba's two rounds at
        # level 3 with vectorisation take three times as long and gain nothing (`tests/bench/kernel.py`).
        options = {"opt": 1, "loop_vectorize": False, "slp_vectorize": False}
        passes, builder = self._codegen._module_pass_manager(**options)
        passes.run(self._final_module, builder)


def _defined(module: Any) -> set[str]:
    return {function.name for function in module.functions if not function.is_declaration}


def _hide_others(module: Any, own: set[str]) -> None:
    """Give internal linkage to the size constants and to all functions of a module except those named in `own`."""
    for value in (*module.functions, *module.global_variables):
        kind = value.is_function or value.name.startswith(_SYMBOL)
        if kind and not value.is_declaration and value.name not in own:
            value.linkage = "internal"


def _link(module: Any, library: Any) -> None:
    """Link an LLVM module with all libraries that it uses, and add the size constants of its system."""
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
    """Yield all libraries that a library links to, directly or through its precompiled parts, each once."""
    seen, waiting = {library}, list(library._linking_libraries)
    while waiting:
        found = waiting.pop(0)
        if found not in seen:
            seen.add(found)
            yield found
            if isinstance(found, PartLibrary):
                waiting += found._linking_libraries


def _definitions(sizes: Mapping[str, Any]) -> str:
    """Return LLVM definitions of the named size constants: integers, and arrays of float64 or int64 by their bits."""
    lines = []
    for name, value in sorted(sizes.items()):
        if isinstance(value, int):
            lines.append(f'@"{_SYMBOL}{name}" = constant i64 {value}')
        else:
            bits = ", ".join(f"i64 {x}" for x in np.array(value).view(np.int64))
            lines.append(f'@"{_SYMBOL}{name}" = constant [{len(value)} x i64] [{bits}], align 8')
    return "\n".join(lines)


def placeholder_of_array(name: str, array: np.ndarray) -> np.ndarray:
    """Return the placeholder that stands for an array of a system (float64 or int64) while a part is compiled."""
    return np.array([placeholder(name)]).view(array.dtype)


def sizes_as_loads(module: ir.Module) -> None:
    """Replace each placeholder integer in an LLVM module by a load from a named constant, which the linker defines
    later.
    """
    names = {value: name for name, value in _NAMES.items()}
    for function in module.functions:
        if function.blocks:
            _load_sizes(module, function, names)


def _arrays_by_name(text: str) -> str:
    """Replace placeholder arrays in LLVM text by references to named constants, which the linker defines later."""
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
            # load at the start of the function, before every use
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
