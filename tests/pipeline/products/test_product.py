"""The product door: declarations that resolve, are light, and say everything once."""

from __future__ import annotations

import inspect
import subprocess
import sys

import pytest

from pipeline.products.product import FigureOptions, StateOptions, default_of, function_of
from pipeline.products.registry import ANALYSES, CELL_PRODUCTS, COMMANDS, FIGURES
from pipeline.specification.problems import SpecError, validated

ALL = [*CELL_PRODUCTS.values(), *ANALYSES.values(), *FIGURES.values()]
NAMES = [f"{type(p).__name__}-{p.name}" for p in ALL]


@pytest.mark.slow
def test_registry__names_are_the_products_own():
    for registry in (CELL_PRODUCTS, ANALYSES, FIGURES):
        assert {name: product.name for name, product in registry.items()} == {n: n for n in registry}


@pytest.mark.parametrize("product", ALL, ids=NAMES)
def test_product__its_functions_are_there(product):
    for role in ("compute", "table", "needs", "settle", "finish", "draw"):
        name = getattr(product, role, "")
        if isinstance(name, str) and name:
            wanted = {"table": 1}.get(role, 2)
            assert len(inspect.signature(function_of(name)).parameters) == wanted, name
    for other in getattr(product, "builds_on", ()):
        assert other in ANALYSES
    assert not getattr(product, "figure", "") or product.figure in FIGURES


@pytest.mark.parametrize("product", ALL, ids=NAMES)
def test_options__each_has_its_sentence_and_its_default_is_in_bounds(product):
    fields = product.options.model_fields
    example = {float: 1.0, str: "q", tuple[str, ...]: ("energy",), tuple[str, str]: ("A", "B")}
    required = {name: example[i.annotation] for name, i in fields.items() if i.is_required()}
    for name, info in fields.items():
        assert info.description, name
        assert not info.description[0].islower(), name
        if not info.is_required():
            validated(product.options, {name: default_of(product.options, name)} | required)
    assert product.help.splitlines()[0].endswith((".", "?"))
    assert len(product.help.splitlines()[0]) <= 110


def test_commands__are_the_analyses_with_a_table():
    assert {name for name, analysis in ANALYSES.items() if analysis.table} == set(COMMANDS)


def test_validated__all_mistakes_in_one_sentence_each():
    with pytest.raises(SpecError) as caught:
        validated(ANALYSES["basins"].options, {"box": 1, "boxx": 2, "interval": "wilsn", "seed": 0.5})
    assert sorted(caught.value.problems) == [
        "box = 1: must be at least 2.",
        "boxx: unknown key; did you mean box?",
        "interval = 'wilsn': must be 'wilson' or 'clopper-pearson'. Did you mean 'wilson'?",
        "seed = 0.5: must be a whole number.",
    ]


def test_label__tells_figures_apart():
    """Options that are not as by default are in the file's name; where it goes is not."""
    assert FigureOptions().label() == ""
    assert FigureOptions(out="a.png", format="pdf").label() == ""
    labels = {
        options.label()
        for options in (
            StateOptions(state="x"),
            StateOptions(state="v"),
            StateOptions(state="x", degrees=True),
            StateOptions(state="x", at={"q": 1.5}),
            StateOptions(state="x", at={"q": 1.6}),
            StateOptions(state="x", width=85.0),
            StateOptions(state="x", xlim=(1.0, 2.0)),
        )
    }
    assert len(labels) == 7
    assert StateOptions(state="x", at={"q": 1.5}).label() == "_x_q_1.5"
    assert all("/" not in label for label in labels)


def test_registry__is_light():
    code = (
        "import sys\n"
        "from pipeline.products.registry import ANALYSES, CELL_PRODUCTS, FIGURES\n"
        "found = [p.options for r in (ANALYSES, CELL_PRODUCTS, FIGURES) for p in r.values()]\n"
        "print([m for m in ('numba', 'numpy', 'xarray', 'zarr', 'dask', 'matplotlib') if m in sys.modules])\n"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
