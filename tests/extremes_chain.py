"""A scene at the extremes from its PLY through all stages. Needs the extra [render]."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from captures import cameras, views_of
from extremes import COUNT, write_small_scene
from extremes_learnt import BLACK, COARSE, QUICK, SHORT, images_of

from csplat import decode, read_ply
from csplat.decoder import read_declared_bounds, read_header
from csplat.encoder import EncodePlan, EncodeResult, encode_with_report, fix_quantisation
from csplat.errors import InputError
from csplat.lint import Finding
from csplat.model import SplatModel
from csplat.ply import lint_ply
from csplat_conformance.declared_bounds import BoundsVerification, Source, verify_bounds
from csplat_render import Camera, render
from csplat_render.conventions import RenderResult
from csplat_render.virtual_cameras import virtual_cameras
from csplat_tools.optimise.pruning import simplify
from csplat_tools.optimise.pruning_order import SimplifyOptions
from csplat_trainer.training_loop import train
from csplat_trainer.tuning import renders_of, split_views, tune

#: Conditions whose chain goes on to learning in the usual tests: those with the largest values.
LEARNT = ("float32 limits", "exploded")


@dataclass(frozen=True)
class Learnt:
    """A scene after few steps of learning.

    Attributes:
        half: half its splats.
        trained: splats that learnt from photographs of it.
        losses: loss of each step.
        tuned: the decoded scene of its tuned file, or why it cannot be tuned.
    """

    half: SplatModel
    trained: SplatModel
    losses: tuple[float, ...]
    tuned: SplatModel | str


@dataclass(frozen=True)
class Chain:
    """A condition after each stage.

    Attributes:
        source: the scene as it is read.
        findings: findings of its reader.
        linted: ids of the repairs that `lint_ply` names.
        refusal: why strict reading refuses it; "" if it does not.
        result: its file, preset `balanced`.
        decoded: the scene of the file.
        proof: proof of the file's stated errors.
        pictures: renders of source and decoded scene, in the modes `fast` and `exact`.
        learnt: the scene after learning; only for conditions in `LEARNT`.
    """

    source: SplatModel
    findings: tuple[Finding, ...]
    linted: tuple[str, ...]
    refusal: str
    result: EncodeResult
    decoded: SplatModel
    proof: BoundsVerification
    pictures: tuple[RenderResult, ...]
    learnt: Learnt | None


def chain_of(name: str) -> Chain:
    """Take a condition through all stages; of a million splats 2,000."""
    findings: list[Finding] = []
    with tempfile.TemporaryDirectory() as folder:
        path = write_small_scene(Path(folder), name)
        source, refusal = read_ply(path, report=findings), ""
        linted = tuple(one.id for one in lint_ply(path) if one.kind == "repair")
        try:
            read_ply(path, strict=True)
        except InputError as error:
            refusal = str(error)
    result = encode_with_report(source)
    decoded = decode(result.data)
    proof = verify_bounds(
        Source.of(source), decoded, read_header(result.data), read_declared_bounds(result.data), result.source_index
    )
    (camera,) = virtual_cameras(source, 1, 24, 18)
    pictures = [render(model, camera, mode=mode) for model in (source, decoded) for mode in ("fast", "exact")]
    learnt = _learn(source) if name in LEARNT else None
    return Chain(source, tuple(findings), linted, refusal, result, decoded, proof, tuple(pictures), learnt)


def _learn(source: SplatModel) -> Learnt:
    seen_from = cameras(9)
    half = simplify(source, keep=0.5, views=views_of(seen_from), options=SimplifyOptions(rounds=1, effort=1)).model
    options = replace(QUICK, iterations=40, refine_start=10, refine_every=10)
    trained = train(images_of(source, seen_from, source.means[:COUNT]), options)
    try:
        tuned = _tune(source, seen_from)
    except InputError as error:
        tuned = str(error)
    return Learnt(half, trained.model, tuple(trained.log["losses"]), tuned)


def _tune(source: SplatModel, seen_from: list[Camera]) -> SplatModel:
    views = split_views(renders_of(source, seen_from, BLACK, None), BLACK, validation_count=2)
    fixed = fix_quantisation(EncodePlan.of(source, COARSE))
    result = tune(fixed, views, replace(SHORT, iterations=20))
    return decode(fixed.encode(result.best_values).write().data)


def assert_finite(model: SplatModel) -> None:
    """Fail if an array of a scene holds NaN or infinity."""
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        assert np.isfinite(getattr(model, name)).all(), name
