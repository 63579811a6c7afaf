"""The product door: declarations that resolve, are light, and say everything once."""

from __future__ import annotations

import inspect

import pytest

from pipeline.products.product import default_of, function_of
from pipeline.products.registry import ANALYSES, CELL_PRODUCTS, FIGURES
from pipeline.specification.problems import SpecError, validated

ALL = [*CELL_PRODUCTS.values(), *ANALYSES.values(), *FIGURES.values()]
NAMES = [f"{type(p).__name__}-{p.name}" for p in ALL]


@pytest.mark.parametrize("product", ALL, ids=NAMES)
def test_product__its_functions_are_there(product):
    of_role = {"table": 1, "needs": 2, "settle": 2, "parts": 2, "finish": 3, "draw": 2}
    of_role["compute"] = 3 if getattr(product, "parts", "") else 2
    for role, wanted in of_role.items():
        name = getattr(product, role, "")
        if isinstance(name, str) and name:
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
    assert {name for name, analysis in ANALYSES.items() if analysis.table} == set(ANALYSES.listed)


def test_validated__all_mistakes_in_one_sentence_each():
    with pytest.raises(SpecError) as caught:
        validated(ANALYSES["basins"].options, {"box": 1, "boxx": 2, "interval": "wilsn", "seed": 0.5})
    assert sorted(caught.value.problems) == [
        "box = 1: must be at least 2.",
        "boxx: unknown key; did you mean box?",
        "interval = 'wilsn': must be 'wilson' or 'clopper-pearson'. Did you mean 'wilson'?",
        "seed = 0.5: must be a whole number.",
    ]
