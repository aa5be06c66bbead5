"""The rows of the study: what is done to each scene, and measurements of the results."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field, replace

import csplat_trainer
from csplat.decoder import decode, read_header
from csplat.encoder import EncodeOptions
from csplat.errors import InputError
from csplat.model import SplatModel
from csplat_bench.common.command import preset_of
from csplat_bench.common.measuring import timed
from csplat_bench.study.judge import Views
from csplat_bench.study.records import How, Measured, Survivors
from csplat_bench.study.scenes import Subject
from csplat_tools.inspect.file_description import bytes_by_attribute
from csplat_tools.study import (
    ATTRIBUTES,
    KMeans,
    Reduction,
    attribute_floats,
    encode_reduced,
    prune_opacity,
    raw_bytes,
    reduce_model,
)
from csplat_tools.training.tuning_inputs import training_views
from csplat_tools.training.tuning_run import RATE_WEIGHT, SHAPE_ENTRIES
from csplat_tools.views import ViewSet, with_validation_views
from csplat_trainer.tuning import FinetuneOptions

#: Entries of each of six codebooks of 1,000 splats of SH 1: as large as the published row by its rule, 0.0136 MiB.
STUDY_ENTRIES = 98

#: Entries of each codebook in scenes of more than `_SMALL` splats.
SCENE_ENTRIES = 1024

#: Thresholds of opacity for the plot.
TAUS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)

_SMALL = 5000

# After pruning, at SH 0, four ways to spend about 2.3 kB by the published rule on the baseline's 169 splats.
_PLAIN = KMeans(dict.fromkeys(ATTRIBUTES[:5], 32))
_BY_ATTRIBUTE = KMeans({"means": 64, "quats": 16, "scales": 32, "opacities": 8, "sh0": 24})
_ADAPTIVE = KMeans({"means": 0.005, "quats": 0.15, "scales": 0.05, "opacities": 0.01, "sh0": 0.05})
_RESIDUAL = KMeans(dict.fromkeys(ATTRIBUTES[:5], 12), stages=2)


@dataclass(frozen=True)
class Row:
    """One line of a table.

    Attributes:
        name: name in tables.
        reduction: the reduction of the scene.
        preset: preset of the .csplat file.
        decoded: scores are those of the decoded file; otherwise of the scene in float32, before it is coded.
        tuned: the file is tuned by the photographs, bytes being part of the loss.
    """

    name: str
    reduction: Reduction = field(default_factory=Reduction)
    preset: str = "balanced"
    decoded: bool = False
    tuned: bool = False

    @property
    def how(self) -> How:
        """All that the line depends on."""
        kmeans = self.reduction.kmeans
        sizes = None
        if kmeans is not None:
            sizes = {"sizes": dict(kmeans.sizes), "stages": kmeans.stages, "gauge": kmeans.gauge}
        reduction = asdict(self.reduction)
        how: How = {
            "name": self.name, "reduction": reduction, "preset": self.preset, "decoded": self.decoded, "kmeans": sizes,
        }  # fmt: skip
        return {**how, "tuned": True} if self.tuned else how


def rows_of_baseline() -> list[Row]:
    """Return the published rows, with the distilled one, and those that the study left as future work."""
    pruned = {tau: Reduction(tau, sh_degree=0) for tau in (0.005, 0.01, 0.02)}
    study = [Row("baseline"), Row("SH 0", Reduction(sh_degree=0)), Row("SH 0 distilled", _distilled())]
    study += [Row(f"SH 0, τ {tau:g}", reduction) for tau, reduction in pruned.items()]
    every = KMeans(dict.fromkeys(ATTRIBUTES, STUDY_ENTRIES), gauge=False)
    study.append(Row("k-means", Reduction(kmeans=every)))
    files = [Row(f"file, {preset}", preset=preset, decoded=True) for preset in ("balanced", "small")]
    files += [
        Row(f"SH 0, τ 0.02, file, {preset}", pruned[0.02], preset, decoded=True) for preset in ("balanced", "small")
    ]
    files.append(Row("SH 0 distilled, τ 0.02, file, small", _distilled(0.02), "small", decoded=True))
    files += [
        Row("rate in the loss", preset="small", decoded=True, tuned=True),
        Row("τ 0.02, rate in the loss", Reduction(0.02), "small", decoded=True, tuned=True),
    ]
    books = {"plain": _PLAIN, "by attribute": _BY_ATTRIBUTE, "adaptive": _ADAPTIVE, "residual": _RESIDUAL}
    clustered = [
        Row(f"SH 0, τ 0.02, k-means {name}", Reduction(0.02, sh_degree=0, kmeans=kmeans))
        for name, kmeans in books.items()
    ]
    alone = [Row("τ 0.02", Reduction(0.02)), Row("τ 0.02, k-means", Reduction(0.02, kmeans=every))]
    return [*study, *alone, *files, *clustered]


def rows_of_scene(subject: Subject) -> list[Row]:
    """The same for every scene: what the claims are looked up in."""
    entries = STUDY_ENTRIES if len(subject.source) <= _SMALL else SCENE_ENTRIES
    every = KMeans(dict.fromkeys(ATTRIBUTES, entries), gauge=False)
    rows = [Row("baseline")]
    if subject.source.sh_degree:
        rows += [Row("SH 0", Reduction(sh_degree=0)), Row("SH 0 distilled", _distilled())]
    rows += [Row(f"τ {tau:g}", Reduction(tau)) for tau in (0.005, 0.02)]
    rows += [Row(f"SH 0, τ {tau:g}", Reduction(tau, sh_degree=0)) for tau in (0.005, 0.01, 0.02)]
    rows += [
        Row("k-means", Reduction(kmeans=every)),
        Row("τ 0.02, k-means", Reduction(0.02, kmeans=every)),
        Row("file, balanced", decoded=True),
        Row("file, small", preset="small", decoded=True),
        Row("SH 0, τ 0.02, file, small", Reduction(0.02, sh_degree=0), "small", decoded=True),
    ]
    if subject.images is not None and len(subject.source) <= _SMALL:
        rows.append(Row("rate in the loss", preset="small", decoded=True, tuned=True))
    return rows


def rows_of_render() -> list[Row]:
    """For the baseline's renders at larger sizes, where the baseline itself is what is compared with."""
    return [row for row in rows_of_baseline() if row.name in _RENDERED]


_RENDERED = (
    "SH 0", "SH 0 distilled", "SH 0, τ 0.005", "SH 0, τ 0.02", "k-means", "file, small", "SH 0, τ 0.02, file, small",
)  # fmt: skip


def measure_row(subject: Subject, row: Row) -> Measured:
    """Do it, write the file, score it."""
    start = time.perf_counter()
    views = None
    if subject.teachers is not None:
        views = with_validation_views(ViewSet(subject.name, subject.views.background, subject.teachers, (), ()))
    reduced, strategy = timed(reduce_model, subject.source, row.reduction, views)
    options = EncodeOptions(preset=preset_of(row.preset))
    if row.tuned:
        data, encoding = timed(_tuned, subject, reduced.model, options)
    else:
        encoded, encoding = timed(encode_reduced, subject.source, row.reduction, options, views=views)
        data = encoded.data
    decoded = decode(data)
    scores = subject.views.score(decoded if row.decoded else reduced.model)
    file = scores if row.decoded else subject.views.score(decoded, quick=True)
    return {
        "how": row.how,
        **scores,
        "splats": len(reduced.model),
        "study_bytes": reduced.size_bytes,
        "csplat_bytes": len(data),
        "file_psnr_mean": file["psnr_mean"],
        "file_psnr_std": file["psnr_std"],
        "books": {} if reduced.clustered is None else reduced.clustered.as_json(),
        "strategy_seconds": strategy.wall,
        "encode_seconds": encoding.wall,
        "seconds": time.perf_counter() - start,
    }


def _tuned(subject: Subject, model: SplatModel, options: EncodeOptions) -> bytes:
    """A file that was tuned by the photographs, as `csplat finetune --data … --keep-unseen` does."""
    if subject.images is None:
        raise InputError(f"{subject.name} has no photographs that a file could be tuned by")
    views = training_views(model, subject.images, None)
    options = replace(options, shape_codebook_size=SHAPE_ENTRIES)
    return csplat_trainer.finetune(model, views, options, FinetuneOptions(byte_cost=RATE_WEIGHT[False])).data


def measure_taus(source: SplatModel, views: Views) -> list[Survivors]:
    """Survivors and PSNR by threshold, SH as it is."""
    found = list[Survivors]()
    for tau in TAUS:
        if float(source.opacities.max()) <= tau:
            break
        pruned, _ = prune_opacity(source, tau)
        found.append({"tau": tau, "splats": len(pruned), **views.score(pruned, quick=True)})
    return found


def attribute_bytes(subject: Subject) -> dict[str, dict[str, int]]:
    """Bytes by attribute of float32 and of files; the frame of a file is what is no attribute."""
    source = subject.source
    floats = {name: raw_bytes(number, len(source)) for name, number in attribute_floats(source.sh_degree).items()}
    files = {"float32": {**floats, "frame": 0}}
    wanted = {"balanced": Reduction(), "small": Reduction(), "small, SH 0, τ 0.02": Reduction(0.02, sh_degree=0)}
    for name, reduction in wanted.items():
        data = encode_reduced(source, reduction, EncodeOptions(preset=preset_of(name.partition(",")[0]))).data
        used = bytes_by_attribute(data, read_header(data))
        del used["overhead"]
        files[name] = {**_gathered(used), "frame": len(data) - sum(used.values())}
    return files


def baseline_bytes(source: SplatModel) -> int:
    """Bytes of the whole scene in float32: what all ratios are to."""
    return raw_bytes(sum(attribute_floats(source.sh_degree).values()), len(source))


def _gathered(used: dict[str, int]) -> dict[str, int]:
    """The bands of SH above 0 together."""
    names = {"sh1": "shN", "sh2": "shN", "sh3": "shN"}
    together: dict[str, int] = dict.fromkeys(ATTRIBUTES, 0)
    for name, size in used.items():
        together[names.get(name, name)] = together.get(names.get(name, name), 0) + size
    return together


def _distilled(tau: float | None = None) -> Reduction:
    return Reduction(tau, sh_degree=0, distil=True)
