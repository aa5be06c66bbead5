# SPDX-License-Identifier: Apache-2.0
"""Trainings that end in a given time: their settings, and the command that repeats them."""

from __future__ import annotations

import shlex
from unittest.mock import Mock

import pytest
from captures import write_photographs
from command_line import call

from csplat.encoder import Target
from csplat.errors import InputError
from csplat.ply import read_ply
from csplat_tools.training import time_plan
from csplat_tools.training.time_plan import StepCost, candidate_sizes, choose_settings, expected_loss
from csplat_tools.training.training_run import plan_training
from csplat_trainer.training_options import TrainOptions

COST = StepCost(1e-3, 5e-8, 3e-7, 1e-12)  # seconds; about that of two cores
PHOTOGRAPHS = (960, 540)


def chosen(seconds, cost=COST, unscaled=PHOTOGRAPHS, image_count=50, **options):
    sizes = candidate_sizes([unscaled])
    return choose_settings(cost, seconds, sizes, unscaled, image_count, **{"to_file": True, **options})


def test_the_cost_of_a_step_is_learnt_from_four_and_never_negative():
    places = [(pixels, splats) for pixels in (10_000, 500_000) for splats in (5_000, 80_000)]
    found = StepCost.of({place: COST.seconds(*place) for place in places})
    assert COST.seconds(200_000, 30_000) == pytest.approx(found.seconds(200_000, 30_000))
    noisy = StepCost.of(dict(zip(places, (0.02, 0.01, 0.03, 0.01), strict=True)))
    assert min(noisy.base, noisy.per_pixel, noisy.per_splat, noisy.per_both) >= 0.0


def test_more_time_gives_a_better_training_within_the_time():
    losses = []
    for minutes in (1, 3, 10, 30, 60, 600):
        plan = chosen(60.0 * minutes)
        assert plan.seconds <= 60.0 * minutes
        pixels = 1.0 if plan.size is None else plan.size[0] * plan.size[1] / (960 * 540)
        losses.append(expected_loss(pixels, plan.max_splats, plan.iterations))
    assert sorted(losses, reverse=True) == losses
    assert (None, None, 30_000) == (plan.size, plan.scaled_from, plan.iterations)  # more steps are not worth their time
    assert plan.seconds < 36_000.0


def test_large_images_are_scaled_down_and_slow_machines_train_less():
    plan = chosen(600.0, unscaled=(4000, 3000))
    assert ((1000, 750), (4000, 3000)) == (plan.size, plan.scaled_from)
    assert plan.max_splats <= 0.5 * 1000 * 750
    slow = StepCost(*(20.0 * part for part in (COST.base, COST.per_pixel, COST.per_splat, COST.per_both)))
    fast, late = chosen(1800.0), chosen(1800.0, cost=slow)
    assert late.iterations < fast.iterations
    assert late.max_splats < fast.max_splats
    hopeless = chosen(1.0, cost=slow)
    assert 100 == hopeless.iterations
    assert hopeless.seconds > 1.0


def test_given_settings_are_kept_and_numbers_are_short():
    assert 12_345 == chosen(600.0, max_splats=12_345).max_splats
    assert 2_000 == chosen(600.0, most_splats=2_345).max_splats  # those that a size holds
    assert 345 == chosen(600.0, most_splats=345).max_splats
    plan = chosen(777.0)
    assert all(len(str(number).rstrip("0")) <= 2 for number in (plan.max_splats, plan.iterations))
    assert (
        chosen(600.0, to_file=False).iterations > chosen(600.0, to_file=True, max_splats=plan.max_splats).iterations / 2
    )


def test_images_of_several_shapes_are_not_scaled():
    assert [None, (2000, 1500), (1000, 750), (500, 375)] == candidate_sizes([(4000, 3000), (3990, 3000)])
    assert [None] == candidate_sizes([(4000, 3000), (3000, 4000)])
    assert [None, (120, 100)] == candidate_sizes([(240, 200)])


@pytest.mark.slow
def test_the_printed_command_makes_the_same_file_and_resume_takes_its_settings(tmp_path, monkeypatch):
    photographs, timed, again, resumed = (tmp_path / name for name in ("data", "a.csplat", "b.csplat", "c.csplat"))
    write_photographs(photographs)
    monkeypatch.setattr(time_plan, "_LEAST_SIDE", 8)  # the images are smaller than any that would be scaled
    monkeypatch.setattr(time_plan, "candidate_sizes", lambda sizes: candidate_sizes(sizes)[1:2])
    monkeypatch.setattr(time_plan, "_SPLATS", (500, 2000))  # seconds less
    monkeypatch.setattr("csplat_tools.console.LONG_WORK_SECONDS", 0.0)
    options = ("--sh-degree", 0, "--target-size", "5kB", "--checkpoint", tmp_path / "run.npz")
    messages = call("train", photographs, timed, "--time", "1s", *options).stderr
    assert "images of half their width and height lose details" in messages
    assert "; --size 48x40 keeps them\n" in messages
    assert 1 == messages.count("takes about")  # the plan, but neither training nor tuning
    (line,) = (line for line in messages.splitlines() if line.startswith("to repeat it: csplat train "))
    words = shlex.split(line.removeprefix("to repeat it: csplat "))
    assert {"--max-splats", "--iterations", "--size"} <= {*words}
    assert "--time" not in words
    messages = call(*[str(again) if word == str(timed) else word for word in words], "--force").stderr
    assert "training takes about" in messages
    assert timed.read_bytes() == again.read_bytes()
    call("train", photographs, resumed, "--resume", tmp_path / "run.npz", *options[:4])
    assert timed.read_bytes() == resumed.read_bytes()


def test_a_timed_training_for_a_size_may_have_three_times_the_splats_that_the_file_keeps(tmp_path, monkeypatch):
    write_photographs(tmp_path)
    plan = Mock(side_effect=InputError("planned"))
    monkeypatch.setattr(time_plan, "plan_in_time", plan)
    call("train", tmp_path, tmp_path / "a.csplat", "--target-size", "80kB", status=1)
    assert 24_000 == plan.call_args.kwargs["most_splats"]
    options = plan_training(TrainOptions(), Target(size=80_000), max_splats=24_000)
    assert 8_000 == pytest.approx(24_000 * options.final_share)


@pytest.mark.slow
def test_a_time_excludes_steps_and_must_be_one(tmp_path, monkeypatch):
    write_photographs(tmp_path)
    monkeypatch.setattr(time_plan, "_SPLATS", (500, 2000))  # seconds less
    for words in (("--time", "1h", "--iterations", 5), ("--time", "soon"), ("--time", "1h", "--resume", "a.npz")):
        assert "--time" in call("train", tmp_path, tmp_path / "a.ply", *words, status=2).stderr or words[1] == "soon"
    call("train", tmp_path, tmp_path / "a.ply", "--time", "1s", "--max-splats", 30, "--sh-degree", 0)
    assert 30 == len(read_ply(tmp_path / "a.ply"))
