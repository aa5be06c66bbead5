"""The decoder in Chromium: every vector, with WebAssembly, and under a policy that forbids it and workers.

`codec/js/test/browser.mjs` runs the same page in other browsers.
"""

import json
import time

import pytest
from chromium import IN_CHROMIUM

pytestmark = [*IN_CHROMIUM, pytest.mark.area(name="chromium")]


@pytest.mark.parametrize(
    ("policy", "expected"),
    [
        ("", {"compiled": True, "workers": 2}),
        ("script-src 'self' 'unsafe-inline'; worker-src 'none'", {"compiled": False, "workers": 0}),
    ],
    ids=["WebAssembly", "JavaScript"],
)
def test_decodes_every_vector(tab, site, policy, expected):
    results = []

    def take(route):
        results.append(route.request.post_data_json)
        route.fulfill(json={"more": False})

    site.policy = policy
    site.add("/expected", json.dumps(expected).encode())
    tab.page.route("**/result", take)
    tab.page.goto(site.url("/codec/js/test/browser.html"))
    end = time.monotonic() + 120.0
    while not results:
        assert time.monotonic() < end, "no result came"
        tab.page.wait_for_timeout(100)
    (result,) = results
    assert [] == result["failures"]
    assert result["count"] > 700
    tab.problems.clear()  # the browser reports what the policy forbids
