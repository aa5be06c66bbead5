# SPDX-License-Identifier: Apache-2.0
"""Pages of images with borders between them."""

import numpy as np
import pytest

from csplat_tools.slider_page import Panel, slider_page

ENDS = "[...document.querySelectorAll('[role=slider]')].map((one) => Number(one.getAttribute('aria-valuenow')))"


@pytest.fixture
def page(tmp_path):
    """A page of one view with three images, and of one with two."""
    views = [[Panel.of(f"<{k}>", "", np.full((30, 40, 3), 80 * k, np.uint8)) for k in range(count)] for count in (3, 2)]
    (tmp_path / "page.html").write_text(slider_page("a & b", "About.", views), "utf-8")
    return tmp_path / "page.html"


def test_titles_are_escaped(page):
    text = page.read_text("utf-8")
    assert 2 == text.count("a &amp; b")
    assert 2 == text.count("<b>&lt;1&gt;</b>")


@pytest.mark.browser
def test_borders_follow_keys_and_fingers(page, browser):
    tab = browser.new_page(viewport={"width": 390, "height": 700}, has_touch=True)
    problems = []
    tab.on("pageerror", lambda error: problems.append(str(error)))
    tab.goto(page.as_uri())
    assert [33, 67, 50] == tab.evaluate(ENDS)
    tab.keyboard.press("Tab")
    tab.keyboard.press("End")  # the other border goes along
    assert [100, 100, 50] == tab.evaluate(ENDS)
    tab.keyboard.press("Home")
    assert [0, 100, 50] == tab.evaluate(ENDS)
    box = tab.locator(".stage").first.bounding_box()
    tab.touchscreen.tap(box["x"] + 0.8 * box["width"], box["y"] + 20)
    assert [0, 80, 50] == tab.evaluate(ENDS)
    assert "inset(0px 0px 0px 80%)" == tab.evaluate("getComputedStyle(document.querySelectorAll('img')[2]).clipPath")
    assert tab.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert [] == problems
    tab.close()
