"""Import packages that only some commands need: those of the optional dependencies in pyproject.toml."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from pipeline.specification.problems import SpecError

INSTALL = "pip install '.[{}]' in a checkout of magpend"


def import_extra(package: str, extra: str, asker: str) -> Any:
    """Import a package of an extra.

    Parameters
    ----------
    package
        Name of the package.
    extra
        Name of the extra that has it.
    asker
        Option or file that needs the package, for the message.

    Raises
    ------
    SpecError
        If the package is not installed.
    """
    try:
        return import_module(package)
    except ModuleNotFoundError:
        how = INSTALL.format(extra)
        raise SpecError(f"{asker}: needs {package}, which is not installed: {how}.") from None
