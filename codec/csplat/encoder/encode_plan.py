# SPDX-License-Identifier: Apache-2.0
"""Plan the encoding of a scene: steps, quantisation classes, tiles and shape codebook, before colours are final.

    plan = EncodePlan.of(model, options)
    encoded = encode_tiles(plan)
    encoded.write({"fitted": {"psnr": measure(encoded.write().data)}})

The encoder has no renderer. A caller with a renderer can record the PSNR of the file in the file. A caller that tunes
the values uses `fix_quantisation` instead of `encode_tiles`.
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
from csplat.context import DEFAULT_CONTEXT, Context
from csplat.encoder.buckets import BucketStore, MemoryBuckets, bucket_rows
from csplat.encoder.coding_parameters import CodingParameters, choose_parameters, tile_limit
from csplat.encoder.encode_options import EncodeOptions
from csplat.encoder.error_bounds import SCALE_MOST
from csplat.encoder.quantisation_classes import QuantisationClasses, choose_classes
from csplat.encoder.sh_codebook import FileCodebooks, choose_sh_coding, final_parameters
from csplat.encoder.shape_codebook import ShapeCodebook, choose_shapes, dequantise_shapes
from csplat.encoder.source_lattices import keep_lattices
from csplat.encoder.splat_importance import (
    Importance,
    get_blocks,
    project_sh,
    sh_metric,
    shape_metric,
    shape_weights,
    splat_weights,
)
from csplat.encoder.tiling import TileSplats, cut_scene, dequantise_means, dequantise_opacities
from csplat.errors import InputError
from csplat.model import SplatModel, check_model
from csplat.types import I64


@dataclass(frozen=True, eq=False)
class Origin:
    """The source of a pruned or refitted scene.

    Attributes:
        source_count: number of splats of the source.
        source_index: [N] int64, index in the source of each splat.
        refitted: colours differ from the source; the file declares no errors for them.
        adjusted: opacities, rotations or scales differ, too.
    """

    source_count: int
    source_index: I64
    refitted: bool = False
    adjusted: bool = False


@dataclass(frozen=True, eq=False)
class EncodePlan:
    """A scene, and the encoder's choices about its geometry.

    Attributes:
        model: the scene, with the colours to encode; without splats if they are on disk.
        options: the caller's options.
        origin: the source of the scene.
        importance: importance of the splats, if known.
        parameters: steps and codings; the SH coding may still be "auto".
        tiles: rows of the model and steps of each tile.
        extras: records of the extra columns to write.
        shapes: the shape codebook; `None` without a codebook.
        classes: quantisation classes of the splats, if there are several.
        sample: plan of the sample on which choices are made, for a scene of several buckets without importance.
        buckets: `BucketStore.rows` of such a scene.
        is_sample: the model is such a sample.
        context: threads, seed and progress of all steps; progress is called from any thread.
    """

    model: SplatModel
    options: EncodeOptions
    origin: Origin
    importance: NDArray[Any] | Importance | None
    parameters: CodingParameters
    tiles: Sequence[TileSplats]
    extras: Sequence[_spec.ExtraRecord]
    shapes: ShapeCodebook | None
    classes: QuantisationClasses | None
    sample: EncodePlan | None = None
    buckets: Sequence[NDArray[np.intp]] = ()
    is_sample: bool = False
    context: Context = DEFAULT_CONTEXT

    @classmethod
    def of(
        cls,
        model: SplatModel,
        options: EncodeOptions | None = None,
        *,
        importance: NDArray[Any] | Importance | None = None,
        origin: Origin | None = None,
        allow_classes: bool = True,
        contrast: float | None = None,
        context: Context = DEFAULT_CONTEXT,
    ) -> EncodePlan:
        """Plan the encoding of a scene.

        Args:
            model: the scene.
            options: default: the preset "balanced".
            importance: [N] weights >= 0 of the splats, or an `Importance`; default: guessed from opacity and size. If
                it has `sh_metric`, dropped SH bands are projected onto the others, and the colours are refitted.
            origin: the source of the scene; `None`: the scene itself.
            allow_classes: allow several quantisation classes, if the importance has Gauss-Newton blocks.
            contrast: contrast of the scene that the model is a sample of; see `contrast_of`.
            context: see `EncodePlan`.

        Raises:
            InputError: a value fits no lattice, an option is not allowed for the model, or importance or origin have
                another number of splats.
        """
        check_model("the encoder", model)
        options = EncodeOptions() if options is None else options
        if not isinstance(options, EncodeOptions):
            raise InputError(f"options is {options!r}, expected csplat.EncodeOptions(preset=...)")
        origin = origin or Origin(len(model), np.arange(len(model)))
        if len(origin.source_index) != len(model):
            raise InputError(f"origin has {len(origin.source_index)} splats, expected {len(model)}")
        model = clip_scales(model)
        degree = options.kept_degree(model.sh_degree)
        if degree < model.sh_degree and isinstance(importance, Importance) and importance.sh_metric is not None:
            model, origin = project_sh(model, degree, importance), replace(origin, refitted=True)
        if len(model) > options.bucket_splats and importance is None and not options.shape_codebook_size:
            return cls.of_buckets(MemoryBuckets.of(model, options.bucket_splats, context), options, origin, context)
        parameters = choose_parameters(model, options, importance_given=importance is not None, contrast=contrast)
        parameters = keep_lattices(model, parameters, options)
        extras = extra_records(model, options)
        blocks = get_blocks(model, importance) if allow_classes else None
        parameters, classes = choose_classes(model, blocks, parameters, options)
        if classes is not None and options.tile_splats is None:  # has tiles for each class already
            parameters = replace(parameters, tile_splats=_spec.TILE_SPLATS_MAX)
        buckets = bucket_rows(model.means, options.bucket_splats) if classes is None else None
        tiles = cut_scene(model, parameters, classes, buckets)
        shapes = None
        if options.shape_codebook_size and len(model):
            weights = shape_weights(model, importance)
            metric = shape_metric(weights, importance)
            shapes = choose_shapes(model, weights, metric, tiles, parameters, options, context)
        return cls(
            model,
            options,
            origin,
            importance,
            parameters,
            tiles,
            extras,
            shapes,
            classes,
            is_sample=contrast is not None,
            context=context,
        )

    @classmethod
    def of_buckets(
        cls, store: BucketStore, options: EncodeOptions, origin: Origin, context: Context = DEFAULT_CONTEXT
    ) -> EncodePlan:
        """Plan the encoding of a scene of several buckets on a sample of it.

        Args:
            store: the scene, in memory or on disk.
            options, origin, context: as for `of`.

        Raises:
            InputError: as in `of`.
        """
        survey = store.survey()
        sample = cls.of(survey.sample, options, contrast=survey.contrast, context=context)
        parameters = final_parameters(sample.parameters, survey.largest_sh)
        parameters = replace(parameters, tile_splats=tile_limit(survey.count, options))
        sample = replace(sample, parameters=parameters)
        tiles = cut_scene(store.model, sample.parameters, buckets=store.rows)
        return replace(sample, model=store.model, origin=origin, tiles=tiles, sample=sample, buckets=store.rows)

    @cached_property
    def scene(self) -> SplatModel:
        """The scene with means, shapes and opacities as decoded, in the model's order; colours are unchanged."""
        model, tiles, parameters = self.model, self.tiles, self.parameters
        quats, scales = dequantise_shapes(model.quats, model.scales, tiles, parameters, self.shapes)
        return replace(
            model,
            means=dequantise_means(model.means, tiles, parameters.lattice),
            quats=quats,
            scales=scales,
            opacities=dequantise_opacities(model.opacities, tiles, parameters),
            means_double=None,
        )

    def choose_sh_coding(self) -> tuple[EncodePlan, FileCodebooks]:
        """Choose the SH coding; return the complete plan and the codebooks with the assignment of the splats.

        For a scene of several buckets, it is the assignment of the sample (`ShCodingPlan.of_sample`).
        """
        model, parameters, importance = self.model, self.parameters, self.importance
        if self.sample is not None:
            sample, codebooks = self.sample.choose_sh_coding()
            codebooks = replace(codebooks, sh_plan=replace(codebooks.sh_plan, of_sample=True))
            return replace(self, parameters=sample.parameters, sample=None), codebooks
        uses_weights = parameters.adaptive > 0.0 or parameters.sh_coding in ("auto", "codebook")
        weights = splat_weights(model, importance) if importance is not None or uses_weights else None
        parameters, codebooks = choose_sh_coding(
            model,
            parameters,
            self.options,
            weights=weights,
            metric=sh_metric(model, weights, importance),
            measured=importance is not None,
            is_sample=self.is_sample,
            trial=trial_rows(model, self.tiles, self.classes),
            context=self.context,
        )
        return replace(self, parameters=parameters), codebooks


def trial_rows(model: SplatModel, tiles: Sequence[TileSplats], classes: QuantisationClasses | None) -> NDArray[np.intp]:
    """Return the rows on which SH codings are compared: about one tile, from all quantisation classes."""
    if not tiles:
        return np.zeros(0, np.intp)
    if classes is None:
        return tiles[len(tiles) // 2].rows
    return np.arange(0, len(model), math.ceil(len(model) / _spec.TILE_SPLATS_MAX))


def clip_scales(model: SplatModel) -> SplatModel:
    """Clip log scales to ±88, beyond which decoders treat them alike (CNF-6), so that they coarsen no lattice."""
    if not len(model) or float(np.abs(model.scales).max()) <= SCALE_MOST:
        return model
    return replace(model, scales=np.clip(model.scales, -SCALE_MOST, SCALE_MOST))


def extra_records(model: SplatModel, options: EncodeOptions) -> list[_spec.ExtraRecord]:
    """Return the records of the extra columns to write, none without `keep_extra`."""
    records: list[_spec.ExtraRecord] = []
    if not options.keep_extra:
        return records
    if len(model.extra) > _spec.EXTRA_COLUMNS_MAX:
        raise InputError(f"the model has {len(model.extra)} extra columns, expected at most {_spec.EXTRA_COLUMNS_MAX}")
    ids = {name: id for id, name in _spec.EXTRA_DTYPE_NAMES.items()}
    for name, column in model.extra.items():
        kind = f"{column.dtype.kind}{8 * column.dtype.itemsize}"
        if kind not in ids:
            names = ", ".join(np.dtype(f"{id[0]}{int(id[1:]) // 8}").name for id in ids)
            raise InputError(f"extra column {name!r} is {column.dtype}, expected {names}: convert it by astype")
        text = _record_text(name, f"the name of extra column {name!r}", 1, _spec.EXTRA_NAME_MAX)
        semantic = model.metadata.semantics.get(name, "")
        meaning = _record_text(semantic, f"the semantic of extra column {name!r}", 0, _spec.EXTRA_SEMANTIC_MAX)
        records.append(
            _spec.ExtraRecord(
                dtype=ids[kind],
                components=column.shape[1] if column.ndim > 1 else 1,
                coding=_spec.CODING_RAW,
                name_size=len(text),
                semantic_size=len(meaning),
                reserved_0=0,
                reserved_1=0,
                name=text.ljust(_spec.EXTRA_NAME_MAX, b"\0"),
                semantic=meaning.ljust(_spec.EXTRA_SEMANTIC_MAX, b"\0"),
            )
        )
    return records


def _record_text(text: str, subject: str, least: int, most: int) -> bytes:
    """Return a text of `least` to `most` bytes in UTF-8; raise an `InputError` about `subject` if it is another."""
    encoded = text.encode()
    if not least <= len(encoded) <= most or any(ord(c) < 32 or ord(c) == 127 for c in text):
        raise InputError(f"{subject} is invalid, expected {least} to {most} bytes without control characters")
    return encoded
