# SPDX-License-Identifier: Apache-2.0
"""The expected work of a search, and the progress that a real search reports by it."""

from dataclasses import replace

import pytest
from captures import cameras, judged_by, shell, views_of
from captures import found_within as search

from csplat import Context, EncodeOptions
from csplat.encoder import Target
from csplat_tools.optimise.candidates import FILE
from csplat_tools.optimise.search_plan import keeps_all, plan_seconds, search_plan, simplify_plan
from csplat_tools.optimise.simplify import SimplifyOptions
from csplat_tools.planned_progress import planned_cost
from csplat_tools.views import with_validation_views

pytestmark = pytest.mark.usefixtures("small_views")


@pytest.fixture(scope="module")
def scene():
    return shell(8)


def cost_of(scene, target, encoding=None, simplify=False):
    pruner = SimplifyOptions(effort=target.effort).pruner(scene, with_validation_views(judged_by(cameras(40))))
    return planned_cost(
        simplify_plan(pruner, target) if simplify else search_plan(pruner, target, encoding or EncodeOptions())
    )


def test_searches_take_longer_with_more_choices_and_effort(scene):
    target, fast = Target(psnr=30.0), EncodeOptions(preset="fast")
    least, most = cost_of(scene, replace(target, prune=False)), cost_of(scene, target)
    assert 0.0 < least < most
    assert {least} == {cost_of(scene, target, one) for one in (fast, EncodeOptions(keep_extra=True))}
    assert keeps_all(replace(target, max_error={"means": 1.0}), EncodeOptions())
    for less in (replace(target, effort=1), Target(keep=0.3)):
        assert cost_of(scene, less) < most
        assert cost_of(scene, less, simplify=True) < cost_of(scene, target, simplify=True) < most
    assert not keeps_all(Target(keep=0.5), fast)


def test_a_plan_takes_time_in_proportion_to_that_of_a_render_and_none_without_splats_or_test_views(scene, monkeypatch):
    monkeypatch.setattr("csplat_tools.optimise.search_plan.render_seconds", lambda *_, **__: 0.5)
    views, target = with_validation_views(judged_by(cameras(40))), Target(psnr=30.0)
    plan = search_plan(SimplifyOptions().pruner(scene, views), target, EncodeOptions())
    drawn = len(views.test) + len(views.validation)  # of one size
    assert 0.5 * drawn == pytest.approx(plan_seconds(plan[:1], scene, views))
    nothing = scene.select(slice(0))
    for source, seen in ((scene, views_of(cameras(8))), (nothing, views)):
        plan = simplify_plan(SimplifyOptions().pruner(source, seen), target)
        assert planned_cost(plan) > 0.0 == plan_seconds(plan, source, seen)


@pytest.mark.slow
@pytest.mark.parametrize("no_prune", [True, False])
def test_a_search_reports_its_phases_a_rising_fraction_and_the_best_file_so_far(scene, no_prune):
    reports = []
    context = Context(progress=lambda stage, done: reports.append((stage, done)))
    found = search(scene, psnr=24.0, no_prune=no_prune, context=context).report.search
    words, fractions = zip(*reports, strict=True)
    assert {"search"} == {text.partition(": ")[0] for text in words}
    assert 0.0 == fractions[0] == min(fractions)
    assert 1.0 == fractions[-1] == max(fractions)
    assert f"{found.validation_psnr:.1f} dB" in words[-1]
    pruner = SimplifyOptions().pruner(scene, with_validation_views(judged_by(cameras(40))))
    plan = search_plan(pruner, Target(psnr=24.0, prune=not no_prune), EncodeOptions())
    stages = {text.partition(": ")[2].partition(";")[0] for text in words}
    # A draft may meet the goal, so that no file is made.
    assert {name for phase in plan for name in phase} - {FILE} == stages - {"", FILE}
