"""Compilation of an engine's parts: code to be linked into their callers, without machine code of their own.

numba optimises every function that it compiles with all that it calls, and makes machine code of it. A
right-hand side that is five calls deep in an engine goes through that five times, of which once counts.
Here the parts stop at intermediate code, and only the entry point is turned into machine code.
"""

from __future__ import annotations

from typing import Any

from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.typed_passes import NopythonTypeInference

from magpend_core.engine.fused import FusedLibrary


class _NoMachineCode:
    """Stands for the code generator where one would look for machine code."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, env_name: str, env: Any) -> None:
        """Do nothing: without machine code there is nothing that an environment could be told to."""


class _PartLibrary(FusedLibrary):
    """Intermediate code to be linked into other code."""

    @property
    def codegen(self) -> Any:
        """The code generator."""
        return _NoMachineCode(self._codegen)

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._verify_declare_only_symbols()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """There is none."""
        self._ensure_finalized()
        return 0


class _RawLibrary(_PartLibrary):
    """Intermediate code that its callers optimise."""

    def _optimize_final_module(self) -> None:
        """Leave that to the entry point's."""


class _GiveLibrary(FunctionPass):
    """Gives a function its library before numba does."""

    library: type[FusedLibrary]

    def __init__(self) -> None:
        FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        """Make the library."""
        state.library = self.library(state.targetctx.codegen(), state.func_id.func_qualname)
        return True


@register_pass(mutates_CFG=False, analysis_only=False)
class _GiveFusedLibrary(_GiveLibrary):
    _name, library = "magpend_fused_library", FusedLibrary

    def run_pass(self, state: Any) -> bool:
        """Make the library, and let its machine code be kept."""
        super().run_pass(state)
        state.library.enable_object_caching()
        return True


@register_pass(mutates_CFG=False, analysis_only=False)
class _GivePartLibrary(_GiveLibrary):
    _name, library = "magpend_part_library", _PartLibrary


@register_pass(mutates_CFG=False, analysis_only=False)
class _GiveRawLibrary(_GiveLibrary):
    _name, library = "magpend_raw_library", _RawLibrary


class FusingCompiler(CompilerBase):
    """numba's compiler of functions, with products fused by our rule (see `fused`)."""

    _gives: type[_GiveLibrary] = _GiveFusedLibrary

    def define_pipelines(self) -> list[Any]:
        """Return numba's own passes with one more."""
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(self._gives, NopythonTypeInference)
        passes.finalize()
        return [passes]


class PartCompiler(FusingCompiler):
    """The same, up to the optimised intermediate code."""

    _gives = _GivePartLibrary


class RawCompiler(FusingCompiler):
    """The same, up to the intermediate code: faster for small engines, not for large."""

    _gives = _GiveRawLibrary
