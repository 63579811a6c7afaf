"""The strips below the diagram in a real browser."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.pipeline.explorer.browser.conftest import drawn, until

pytestmark = pytest.mark.slow

COLOURED = """(() => {
    const canvas = document.querySelector('.strip[aria-label=Fractions]:not([hidden]) canvas');
    if (!canvas?.width) return 0;
    const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
    let n = 0;
    for (let k = 0; k < data.length; k += 4) {
        const [r, g, b, a] = data.subarray(k, k + 4);
        n += a > 128 && Math.max(r, g, b) - Math.min(r, g, b) > 60;
    }
    return n;
})()"""
"""Number of coloured pixels in the strip of fractions: axes and texts are grey."""


def test_fractions__are_drawn_if_their_answer_comes_before_the_diagrams(
    visit: Callable[..., Any], explorer: str
) -> None:
    held: list[Any] = []
    opened = drawn(visit(explorer))
    opened.page.route("**/api/diagram*", lambda route: held.append(route))
    opened.page.reload()
    until(opened.page, "document.querySelector('.strip[aria-label=Fractions]:not([hidden]) canvas')?.width > 300")
    opened.page.wait_for_timeout(100)  # the strip is painted in the next frame
    held.pop().continue_()
    drawn(opened)
    until(opened.page, f"{COLOURED} > 200")
    assert opened.complaints == []
