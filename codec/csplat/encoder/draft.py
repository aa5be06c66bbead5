"""A draft of a file: geometry is decided and shown as a decoder will see it, colours may still be chosen.

    draft = Draft.of(model, options)
    draft = draft.with_colours(*fitted_to(draft.scene))  # or not: the colours that the scene came with
    coded = draft.coded()
    coded.write({"fitted": {"psnr": judge(coded.write().data)}})

The encoder has no renderer. A caller that has one renders `Draft.scene` before colours are coded, and the file before
it records its own PSNR. A caller that tunes all values uses `Draft.frozen` instead of `Draft.coded`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from csplat import _spec
from csplat.encoder.apart import cut_scene
from csplat.encoder.buckets import WHOLE, bucket_rows, looked_at, sample_rows
from csplat.encoder.codebook import Books, choose_sh, largest_sh, served, settled
from csplat.encoder.coded import Coded
from csplat.encoder.colour import ShBook
from csplat.encoder.frozen import Frozen
from csplat.encoder.gauge import fix_gauge
from csplat.encoder.geometry import seen_means, seen_opacities, seen_shapes
from csplat.encoder.grades import Grades, choose_grades
from csplat.encoder.importance import (
    Importance,
    known_curvatures,
    sh_metric,
    shape_metric,
    shape_weights,
    splat_weights,
)
from csplat.encoder.measure import SCALE_MOST
from csplat.encoder.options import EncodeOptions
from csplat.encoder.plan import Plan, make_plan
from csplat.encoder.scene import extra_columns
from csplat.encoder.shape_codebook import choose_shapes
from csplat.encoder.shape_tables import ShapeTables
from csplat.encoder.statistics import contrast_of
from csplat.encoder.tile import tile_order
from csplat.encoder.tiling import Tile
from csplat.errors import InputError
from csplat.model import SplatModel, check_model
from csplat.types import F32, I64, Progress, null_progress


@dataclass(frozen=True, eq=False)
class Origin:
    """The source that a scene was derived from: a larger scene, or one that looked different.

    Attributes:
        source_count: splats of the source.
        source_index: [N] int64, index in the source of each splat.
        refitted: colours differ from those of the source; the file declares no errors for them.
        adjusted: opacities, rotations or scales differ too.
    """

    source_count: int
    source_index: I64
    refitted: bool = False
    adjusted: bool = False


@dataclass(frozen=True, eq=False)
class Draft:
    """A scene whose geometry is decided: lattices, quantisation classes, tiles, codebook of shapes.

    Attributes:
        model: the scene, with the colours that are to be coded.
        options: the caller's options.
        origin: the source that the scene was derived from.
        importance: importance of its splats for renders, as far as the caller knows.
        plan: lattices and codings; that of SH may still be open.
        tiles: rows of the model and lattice, by tile.
        extras: records of the extra columns that are carried.
        shapes: the codebook of shapes, if there is one.
        grades: quantisation classes of the splats, if there are several.
        sample: for a scene of many splats about which nothing else is known: the draft of the sample on which
            decisions are made.
        buckets: rows of each bucket of such a scene.
    """

    model: SplatModel
    options: EncodeOptions
    origin: Origin
    importance: NDArray[Any] | Importance | None
    plan: Plan
    tiles: Sequence[Tile]
    extras: Sequence[_spec.ExtraRecord]
    shapes: ShapeTables | None
    grades: Grades | None
    sample: Draft | None = None
    buckets: Sequence[NDArray[np.intp]] = ()

    @classmethod
    def of(
        cls,
        model: SplatModel,
        options: EncodeOptions | None = None,
        *,
        importance: NDArray[Any] | Importance | None = None,
        origin: Origin | None = None,
        graded: bool = True,
        contrast: float | None = None,
        progress: Progress | None = None,
    ) -> Draft:
        """Decide a scene's geometry.

        Args:
            model: the scene.
            options: presets and knobs; the default preset is "balanced".
            importance: [N] weights >= 0 of the splats, in place of opacity × projected area; or more than that.
            origin: the source that the scene was derived from; `None`: the scene itself.
            graded: allow several quantisation classes; otherwise all splats are in one, whatever is known of them.
            contrast: contrast of the scene that the model is a sample of (`contrast_of`).
            progress: called with the stage's name and the share done, 0 to 1; from any thread.

        Raises:
            InputError: values that no lattice can hold, an option that the model does not allow, an importance of
                other splats, or an origin of others.
        """
        check_model("the encoder", model)
        options = EncodeOptions() if options is None else options
        if not isinstance(options, EncodeOptions):
            raise InputError(f"options is {options!r}, wanted csplat.EncodeOptions(preset=...)")
        origin = origin or Origin(len(model), np.arange(len(model)))
        if len(origin.source_index) != len(model):
            raise InputError(f"an origin of {len(origin.source_index)} splats, wanted {len(model)}")
        model = within_binary32(model)
        if len(model) > WHOLE and importance is None and not options.shape_codebook_size:
            return cls._of_many(model, options, origin, progress)
        plan = make_plan(model, options, importance_given=importance is not None, contrast=contrast)
        extras = extra_columns(model, options)
        curvatures = known_curvatures(model, importance) if graded else None
        plan, grades = choose_grades(model, curvatures, plan, options)
        tiles = cut_scene(model, plan, grades)
        shapes = None
        if options.shape_codebook_size and len(model):
            weights = shape_weights(model, importance)
            metric = shape_metric(weights, importance)
            shapes = choose_shapes(model, weights, metric, tiles, plan, options, progress or null_progress)
        return cls(model, options, origin, importance, plan, tiles, extras, shapes, grades)

    @classmethod
    def _of_many(cls, model: SplatModel, options: EncodeOptions, origin: Origin, progress: Progress | None) -> Draft:
        buckets = bucket_rows(model.means)
        contrast = contrast_of(model.select(buckets[place]) for place in looked_at(len(buckets)))
        sample = cls.of(model.select(sample_rows(len(model))), options, contrast=contrast, progress=progress)
        sample = replace(sample, plan=settled(sample.plan, largest_sh(model.shN)))
        tiles, extras = cut_scene(model, sample.plan, buckets=buckets), extra_columns(model, options)
        return cls(model, options, origin, None, sample.plan, tiles, extras, None, None, sample, buckets)

    @cached_property
    def scene(self) -> SplatModel:
        """The scene as a decoder will see it, in its order of splats, but for the colours, which are as they are."""
        model, tiles, plan = self.model, self.tiles, self.plan
        quats, scales = seen_shapes(model.quats, model.scales, tiles, plan, self.shapes)
        means, opacities = seen_means(model.means, tiles, plan), seen_opacities(model.opacities, tiles, plan)
        return replace(model, means=means, quats=quats, scales=scales, opacities=opacities, means_double=None)

    def with_colours(self, sh0: F32, shN: F32) -> Draft:
        """The same geometry with colours that were fitted anew.

        Args:
            sh0: [N, 3] float32.
            shN: [N, K, 3] float32, of the model's SH degree.

        Raises:
            InputError: they are of another shape or type, or not finite.
        """
        model = replace(self.model, sh0=sh0, shN=shN)
        rows = None if self.sample is None else sample_rows(len(model))
        sample = None if self.sample is None else self.sample.with_colours(sh0[rows], shN[rows])
        return replace(self, model=model, origin=replace(self.origin, refitted=True), sample=sample)

    def coded(self, progress: Progress | None = None) -> Coded:
        """Decide how SH is coded, and code the tiles: most of the work.

        Raises:
            InputError: values that no lattice can hold.
        """
        plan, books = self.decided(progress)
        return Coded.of(replace(self, plan=plan), books, progress=progress)

    def frozen(self, source: SplatModel | None = None, progress: Progress | None = None) -> Frozen:
        """Decide how SH is coded, and leave all values open.

        Args:
            source: the scene that the origin counts the splats of; `None`: the model itself.
            progress: as in `of`.

        Raises:
            InputError: there are no splats, or the source has another number of them than the origin records.
        """
        if not len(self.model):
            raise InputError("a scene without splats has nothing to tune")
        source = self.model if source is None else source
        if len(source) != self.origin.source_count:
            raise InputError(f"a source of {len(source)} splats, wanted {self.origin.source_count}: that of the origin")
        plan, books = self.decided(progress)
        plan = replace(plan, gauged=True)
        rows = [tile_order(self.model, tile, plan)[0] for tile in self.tiles]
        order = np.concatenate(rows).astype(np.int64)
        draft = replace(self._in_order(order, [len(part) for part in rows]), plan=plan)
        return Frozen.of(draft, books.tables.select(order), source)

    def decided(self, progress: Progress | None = None) -> tuple[Plan, Books]:
        """Decide how SH is coded.

        Returns:
            The plan, complete, and the codebooks, with the entry of each splat.
        """
        model, plan, importance = self.model, self.plan, self.importance
        if self.sample is not None:
            return self._served(*self.sample.decided(progress))
        needs_weights = importance is not None or plan.adaptive > 0.0 or plan.sh_coding in ("auto", "codebook")
        weights = splat_weights(model, importance) if needs_weights else None
        sample = tried_rows(model, self.tiles, self.grades)
        return choose_sh(self, weights, sh_metric(model, weights, importance), sample, progress or null_progress)

    def _served(self, plan: Plan, books: Books) -> tuple[Plan, Books]:
        """Apply the decisions made on the sample to all splats."""
        tables, count = books.tables, len(self.model)
        index = None if tables.book is None else np.empty(count, np.int32)
        weights = None if tables.weights is None else np.empty(count, np.float32)
        for rows in self.buckets if index is not None or weights is not None else ():
            part = served(books, self.model.select(rows), plan, self.options.thread_count)
            if weights is not None and part.weights is not None:
                weights[rows] = part.weights
            if index is not None and part.book is not None:
                index[rows] = part.book.index
        book = None if tables.book is None or index is None else ShBook(tables.book.entries, index)
        return plan, replace(books, tables=replace(tables, weights=weights, book=book))

    def _in_order(self, order: I64, counts: Sequence[int]) -> Draft:
        """The same for splats in the order of their tiles, in their gauge; what SH needs of importance is decided."""
        model = self.model.select(order)
        rotation, scales = fix_gauge(model.quats, model.scales)
        ends = np.cumsum(counts)
        return replace(
            self,
            model=replace(model, quats=np.ascontiguousarray(rotation.T), scales=np.ascontiguousarray(scales.T)),
            origin=Origin(self.origin.source_count, self.origin.source_index[order], refitted=True),
            importance=None,
            tiles=[
                replace(tile, rows=np.arange(end - count, end))
                for tile, count, end in zip(self.tiles, counts, ends, strict=True)
            ],
            shapes=None if self.shapes is None else self.shapes.select(order),
            sample=None,
            buckets=(),
        )


def tried_rows(model: SplatModel, tiles: Sequence[Tile], grades: Grades | None) -> NDArray[np.intp]:
    """Return rows like those of one tile, to try codings on: from all quantisation classes, if there are several."""
    if not tiles:
        return np.zeros(0, np.intp)
    if grades is None:
        return tiles[len(tiles) // 2].rows
    return np.arange(0, len(model), math.ceil(len(model) / _spec.TILE_SPLATS_MAX))


def within_binary32(model: SplatModel) -> SplatModel:
    """Write scales beyond ±88 as ±88, as they count (CNF-6): no other splat's lattice has to be coarser for them."""
    if not len(model) or float(np.abs(model.scales).max()) <= SCALE_MOST:
        return model
    return replace(model, scales=np.clip(model.scales, -SCALE_MOST, SCALE_MOST))
