"""Encode a scene of any size to a file: in memory if it fits, otherwise in buckets on disk."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from csplat import __version__
from csplat.disk_files import atomic_writer, check_free_space
from csplat.encoder import EncodeOptions, EncodeReport, encode_with_report
from csplat.encoder.coding_parameters import CodingParameters, measure_contrast
from csplat.encoder.container import file_pieces
from csplat.encoder.encode_plan import EncodePlan, Origin, extra_records
from csplat.encoder.error_bounds import ErrorSums
from csplat.encoder.pipeline import EncodedTile, encoding_settings, file_chunks, make_notes, scene_fields
from csplat.encoder.sh_codebook import FileCodebooks, final_parameters, largest_sh
from csplat.encoder.tiling import BUCKET_SPLATS, BucketCurve, contrast_buckets, sample_rows
from csplat.errors import InputError
from csplat.out_of_core.bucket_workers import BucketCoding, code_here, code_on_cluster, read_coded_bucket
from csplat.out_of_core.spill_files import SpillWriter, SplatLayout, Survey, WorkingFolder, read_splats, spill_path
from csplat.scene_source import SceneSource, with_progress
from csplat.system import default_memory_bytes
from csplat.types import Progress, null_progress

_MB = 1_000_000
_PROGRAM = 120 * _MB  # memory of a process that has loaded the encoder
_PER_ROW = 2.2  # memory for coding a bucket or sample, as a multiple of the size of its arrays
_WHOLE_ROW = 3.0  # memory for encoding a whole scene in memory, likewise
_CODED = 0.3  # maximum size of a file, as a multiple of the size of its arrays
_PENDING = 96 * _MB  # buffer of splats before they are written to their buckets


@dataclass(frozen=True)
class ResourceNeeds:
    """The resources that an encoding needs.

    Attributes:
        in_memory: True if the scene stays in memory.
        workers: number of processes that code buckets.
        memory_bytes: approximate memory of all processes together.
        disk_bytes: maximum size of the working folder and the file.
    """

    in_memory: bool
    workers: int
    memory_bytes: int
    disk_bytes: int


def estimate_needs(
    scene: SceneSource, options: EncodeOptions, memory_bytes: int | None = None, *, by_disk: bool = False
) -> ResourceNeeds:
    """Estimate the resources needed to encode a scene.

    Args:
        scene: the scene; its blocks are not read.
        options: options of the encoder.
        memory_bytes: memory limit; `None`: half of the free memory.
        by_disk: use buckets on disk for a scene of several buckets even if it fits in memory.

    Raises:
        InputError: the limit is too low.
    """
    bound = default_memory_bytes() if memory_bytes is None else memory_bytes
    row = _layout(scene, options).row_bytes
    whole = _PROGRAM + int(scene.count * row * _WHOLE_ROW)
    file_bytes = int(scene.count * row * _CODED)
    if scene.count <= BUCKET_SPLATS or (whole <= bound and not by_disk):
        if memory_bytes is not None and whole > bound:
            raise _too_low(bound, whole)
        return ResourceNeeds(True, options.thread_count, whole, file_bytes)
    if options.shape_codebook_size:
        raise InputError(f"a codebook of shapes requires the scene in memory, about {whole / _MB:,.0f} MB")
    worker = _PROGRAM + int(BUCKET_SPLATS * row * _PER_ROW)
    here = worker + _PENDING
    if here > bound:
        raise _too_low(bound, here)
    workers = max(1, min(options.thread_count, (bound - _PROGRAM) // worker))
    memory = here if workers == 1 else max(here, _PROGRAM + workers * worker)
    return ResourceNeeds(False, workers, memory, scene.count * row + file_bytes)


def _layout(scene: SceneSource, options: EncodeOptions) -> SplatLayout:
    """Return the layout of the arrays that are encoded."""
    return SplatLayout(scene.metadata_model if options.keep_extra else replace(scene.metadata_model, extra={}))


def _too_low(bound: int, least: int) -> InputError:
    return InputError(
        f"{bound / _MB:,.0f} MB of memory are too little for this scene, which requires {least / _MB:,.0f} MB"
    )


def encode_scene(
    scene: SceneSource,
    target: str | os.PathLike[str],
    options: EncodeOptions | None = None,
    *,
    memory_bytes: int | None = None,
    by_disk: bool = False,
    folder: str | os.PathLike[str] | None = None,
    resume: bool = False,
    cluster: str | None = None,
    source: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> EncodeReport:
    """Encode a scene that is read block by block; the bytes are those of `encode`.

    A scene that does not fit in memory is sorted into buckets of neighbours in a working folder on disk. The buckets
    are coded one by one, by `options.threads` processes. If the encoding is interrupted, finished work stays in the
    folder. Scripts must guard their own code by `if __name__ == "__main__":`, because worker processes import it.

    Args:
        scene: the scene, for example from `csplat.formats.open_scene`.
        target: path of the file, which appears when complete.
        options: options of the encoder.
        memory_bytes: memory limit for all processes together; `None`: half of the free memory. The file does not
            depend on it.
        by_disk: use buckets on disk for a scene of several buckets even if it fits in memory.
        folder: the working folder; `None`: the target path with the suffix `.work`.
        resume: continue an interrupted encoding if the folder exists.
        cluster: address of a Dask scheduler whose workers code the buckets; they access the folder under the same path.
        source: identity of the scene, JSON-compatible; checked when resuming.
        progress: called with the stage and the completed fraction of it, 0 to 1.

    Returns:
        The chosen parameters and the error bounds that the file declares.

    Raises:
        InputError: as `encode`; the memory limit is too low; the disk is too small; the folder already exists,
            belongs to another scene or is damaged.
        CsplatError: the scene cannot be read.
        OSError: a file cannot be read or written; or a worker was killed.
    """
    options = options or EncodeOptions()
    path = Path(target)
    work_folder = path.with_name(path.name + ".work") if folder is None else Path(folder)
    by_disk = by_disk or cluster is not None or (resume and work_folder.exists())
    needs = estimate_needs(scene, options, memory_bytes, by_disk=by_disk)
    if needs.in_memory:
        result = encode_with_report(scene.model(), options, progress=progress)
        with atomic_writer(target) as stream:
            stream.write(result.data)
        return result.report
    key = {
        "source": dict(source or {}),
        "options": options.chosen(),
        "splats": scene.count,
        "csplat": __version__,
    }
    work = WorkingFolder.create(work_folder, _layout(scene, options), key, resume=resume)
    return _Encoding(scene, path, options, work, needs, cluster, progress or null_progress).run()


@dataclass(eq=False)
class _Encoding:
    """The stages of an encoding on disk; stages that the working folder has completed are skipped."""

    scene: SceneSource
    target: Path
    options: EncodeOptions
    work: WorkingFolder
    needs: ResourceNeeds
    cluster: str | None
    progress: Progress

    def run(self) -> EncodeReport:
        work = self.work
        if work.state.counts is None:
            work.clear_spill_files()
            self._check_space()
            self._sort()
        if work.state.contrast is None:
            buckets = work.buckets
            some = (buckets[index] for index in contrast_buckets(len(buckets)))
            work.record_progress(
                contrast=measure_contrast(
                    read_splats(spill_path(work.folder, one.file_index), work.layout, one.rows) for one in some
                )
            )
        draft, books = self._decide()
        self._code(BucketCoding(work.layout, draft.parameters, books))
        report = self._write(draft, books)
        work.remove()
        return report

    def _check_space(self) -> None:
        work = self.work
        try:
            check_free_space(work.folder, self.needs.disk_bytes, "this scene is encoded: --work names another folder")
        except InputError:
            if work.state.curve is None:  # no work would be lost
                work.remove()
            raise

    def _sort(self) -> None:
        """Read the scene twice: survey it, then sort its splats into buckets."""
        work, survey = self.work, self.work.read_survey()
        if survey is None:
            survey = take_survey(with_progress(self.scene, "looking", self.progress), work.layout)
            work.write_survey(survey)
        writer = SpillWriter(work.folder, work.layout, survey.curve, _PENDING)
        del survey
        for block in with_progress(self.scene, "sorting", self.progress).blocks():
            writer.add(block)
        writer.flush()
        work.record_progress(counts=writer.counts.tolist())

    def _decide(self) -> tuple[EncodePlan, FileCodebooks]:
        """Choose parameters and codebooks on the sample; return them without the sample's splats."""
        work, survey = self.work, self.work.read_survey()
        assert survey is not None
        sample = EncodePlan.of(survey.sample, self.options, contrast=work.state.contrast, progress=self.progress)
        plan, books = replace(sample, parameters=final_parameters(sample.parameters, survey.largest)).choose_sh_coding(
            self.progress
        )
        return self._without_splats(plan, books)

    def _without_splats(self, plan: CodingParameters, books: FileCodebooks) -> tuple[EncodePlan, FileCodebooks]:
        metadata_model, sh_plan = self.work.layout.metadata_model, books.sh_plan
        none = np.zeros(0, np.intp)
        origin = Origin(self.scene.count, none)
        extras = extra_records(metadata_model, self.options)
        draft = EncodePlan(metadata_model, self.options, origin, None, plan, [], extras, None, None)
        return draft, replace(books, sh_plan=sh_plan.select(none))

    def _code(self, coding: BucketCoding) -> None:
        folder, buckets = self.work.folder, self.work.buckets
        left = {one.index: one for one in buckets if read_coded_bucket(folder, one) is None}
        for bucket in buckets:
            if bucket.index not in left:
                self.work.remove_spill_file(bucket, list(left.values()))
        done = sum(one.stop - one.start for one in buckets if one.index not in left)
        pending = list(left.values())
        if self.cluster is None:
            found = code_here(folder, pending, coding, self.needs.workers)
        else:
            found = code_on_cluster(folder, pending, coding, self.cluster)
        for bucket in found:
            del left[bucket.index]
            self.work.remove_spill_file(bucket, list(left.values()))
            done += bucket.stop - bucket.start
            self.progress("coding", done / self.scene.count)

    def _write(self, draft: EncodePlan, books: FileCodebooks) -> EncodeReport:
        tiles: list[EncodedTile] = []
        for bucket in self.work.buckets:
            tiles += read_coded_bucket(self.work.folder, bucket) or ()
        errors = ErrorSums.total(part.errors for part in tiles)
        settings = encoding_settings(draft, books.sh_plan)
        fields = scene_fields(draft, books, file_chunks(draft, errors, settings))
        size, payloads = 0, sum(len(payload) for part in tiles for payload in part.tile.layers.values())
        with atomic_writer(self.target) as stream:
            for piece in file_pieces(fields, [part.tile for part in tiles]):
                stream.write(piece)
                size += len(piece)
                self.progress("writing", min(1.0, size / max(1, payloads)))
        notes = make_notes(tiles, strict=draft.parameters.lattice.strict)
        return EncodeReport(settings, errors.declared(), errors.count, len(tiles), size, notes)


def take_survey(scene: SceneSource, layout: SplatLayout) -> Survey:
    """Survey a scene of more than `BUCKET_SPLATS` splats.

    Raises:
        CsplatError: the blocks cannot be read.
        OSError: the blocks cannot be read.
    """
    rows = sample_rows(scene.count)
    arrays, largest = layout.empty(len(rows)), 0.0
    for where, block in scene.numbered():
        first, last = np.searchsorted(rows, (where.start, where.stop))
        for array, values in zip(arrays, layout.arrays(block), strict=True):
            array[first:last] = values[rows[first:last] - where.start]
        largest = max(largest, largest_sh(block.shN))
    sample = layout.model(arrays)
    return Survey(sample, largest, BucketCurve.through(sample.means, scene.count))
