# SPDX-License-Identifier: Apache-2.0
"""A scene and an encoder as formulas, for tests of the search for a target without encoding or rendering.

The law, for a file of n splats whose attributes keep q dB each, with x = E(p) the mean squared error of p dB:

    size  = frame + n · (geometry · grading + sh(coding)) · exp(rate · (q - 42)) + book(entries)
    error = E(q - lost) + removal(n) + missing(degree) + book(entries) + E(ceiling)

- `sh` is proportional to the kept coefficients; a codebook costs its indices and entries instead, and its error
  falls with the number of entries.
- `removal` is a power of the number of pruned splats without the unneeded ones; a refit divides it.
- `missing` is the error of the scene without its upper bands.
- `ceiling` bounds the PSNR at any precision: the search has to notice that finer steps gain nothing.

A plateau of q and jumps (every other step of q loses some dB) break the monotony. Each view has the same error; test
views may have a larger one, or a larger one of removal. `AnalyticScene.smallest` and `best` are the reference: they
find the best file by trying everything.
"""

import itertools
import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace

import numpy as np
from checked import cloud

from csplat import EncodeOptions, SplatModel
from csplat.encoder import PRESETS, Target
from csplat.scene import drop_bands
from csplat_tools.optimise.candidates import CandidatePool
from csplat_tools.optimise.pruning import Pruner
from csplat_tools.optimise.search_report import make_report
from csplat_tools.optimise.simplify import SimplifyOptions
from csplat_tools.optimise.target_search import Goal, TargetSearch

USUAL_QUALITY = 42.0  # dB per attribute at which bytes per splat are those of the scene
QUALITIES = np.arange(24.0, 80.0, 0.2)  # dB, the qualities that a search may request
PSNR_CAP = 99.0  # dB
BOOKS = tuple(2**power for power in range(5, 13))


def error_of(psnr):
    return 10.0 ** (-np.asarray(psnr, np.float64) / 10.0)


def psnr_of(error):
    return np.minimum(-10.0 * np.log10(np.maximum(error, 1e-30)), PSNR_CAP)


@dataclass(frozen=True)
class Views:
    offset: float = 0.0  # dB by which errors are larger than in the validation views
    removal_offset: float = 0.0  # dB by which errors of removal are larger in addition
    photo_psnr: float | None = None  # of the source against their images, dB; None: compare with the source


DECIDING = Views()


@dataclass(frozen=True)
class Contents:
    options: EncodeOptions  # those still to be chosen are left open
    splats: int
    refitted: bool = False  # the kept splats were fitted to renders of the source
    graded: bool = False  # splats are sorted by importance
    draft: bool = False  # a refit through its quantisers was left out


@dataclass(frozen=True)
class AnalyticScene:
    splats: int = 8000
    sh_degree: int = 3
    unneeded: int = 0  # splats without effect in any view
    removal_psnr: float = 22.0  # dB after half of the others are pruned, before a refit
    removal_power: float = 3.0  # with which the error grows with the number of pruned splats
    mended: float = 8.0  # dB by which a refit reduces that error
    tuned: float = 2.0  # dB by which a refit through a file's quantisers reduces the error of these
    shown: tuple[float, ...] = (26.0, 32.0, 38.0)  # PSNR with bands up to degree 0, 1 and 2, dB
    frame_bytes: int = 900  # of a file without splats
    splat_bytes: float = 7.0  # per splat at the usual quality
    sh_bytes: float = 3.5
    rate: float = 0.045  # share by which bytes grow with each dB
    lost: float = 10.0  # dB between the quality of the attributes and that of renders
    grading: float = 1.0  # factor of the bytes if splats are sorted by importance
    index_bytes: float = 1.6  # of a codebook of SH, per splat
    entry_bytes: float = 8.0  # per entry
    book_psnr: float = 42.0  # PSNR that a codebook of one entry for 64 splats leaves, dB
    book_octave: float = 2.5  # dB with twice the entries
    ceiling: float = 97.0  # dB that no precision exceeds
    plateau: tuple[float, float] = (0.0, 0.0)  # range of quality that gains nothing, dB
    jump: float = 0.0  # dB that every other step of 0.6 dB of quality loses
    packing: float = 1.008  # factor of the bytes of a file with fast compression
    preset_saving: tuple[str, float] = ("", 0.0)  # a preset, and the share that its own file saves

    def model(self):
        """Return a model with this number of splats; their values do not matter."""
        bands = (self.sh_degree + 1) ** 2 - 1
        return cloud(np.zeros((self.splats, 3)), shN=np.zeros((self.splats, bands, 3), np.float32))

    def options_of(self, contents):
        """Return the encoder's choices, under the names of a file's options."""
        asked = contents.options
        degree = self.sh_degree if asked.sh_degree is None else min(asked.sh_degree, self.sh_degree)
        coding = "scalar" if asked.sh_coding == "auto" else asked.sh_coding
        coding, degree = ("none", 0) if coding == "none" or not degree else (coding, degree)
        entries = (asked.codebook_size or max(16, self.splats // 32)) if coding == "codebook" else 0
        quality = asked.attribute_psnr or PRESETS[asked.preset].quality[coding == "none"]
        return {
            "sh_coding": coding, "sh_degree": degree, "codebook_size": min(entries, contents.splats),
            "quality": quality, "adaptive": asked.adaptive or 0.0, "deflate_level": asked.deflate_level or 12,
            "opacity_levels": 255,
        } | ({"classes": {"splats": [contents.splats // 2] * 2}} if contents.graded else {})  # fmt: skip

    def size_of(self, contents, quality=None):
        """Return the size of a file in bytes, or of one file for each of some qualities."""
        chosen = self.options_of(contents)
        finer = np.exp(self.rate * ((chosen["quality"] if quality is None else quality) - USUAL_QUALITY))
        kept = ((chosen["sh_degree"] + 1) ** 2 - 1) / 15.0
        splat, book = self.splat_bytes * finer * (self.grading if contents.graded else 1.0), 0.0
        if chosen["sh_coding"] == "scalar":
            splat = splat + self.sh_bytes * kept * finer
        elif chosen["sh_coding"] == "codebook":
            splat, book = splat + self.index_bytes, self.entry_bytes * kept * chosen["codebook_size"]
        packed = 1.0 if chosen["deflate_level"] == 12 else self.packing
        saved = 1.0
        if contents.options.attribute_psnr is None and quality is None:
            saved -= self.preset_saving[1] * (contents.options.preset == self.preset_saving[0])
        return np.rint((self.frame_bytes + contents.splats * splat * saved) * packed + book)

    def error_of(self, contents, views=DECIDING, quality=None):
        chosen = self.options_of(contents)
        q = np.asarray(chosen["quality"] if quality is None else quality, np.float64)
        q = q - np.clip(q - self.plateau[0], 0.0, self.plateau[1] - self.plateau[0])
        q = q - self.jump * (np.floor(q / 0.6) % 2)
        gained = (self.tuned * (not contents.draft)) if contents.refitted else 0.0
        error = error_of(q - self.lost + gained) + error_of(self.ceiling)
        if chosen["sh_coding"] == "codebook":
            octaves = math.log2(64.0 * chosen["codebook_size"] / contents.splats)
            error = error + error_of(self.book_psnr + self.book_octave * octaves)
        removed = self.removed(contents.splats, refitted=contents.refitted)
        return self._seen(error + self.missing(chosen["sh_degree"]), removed, views)

    def source_error(self, splats, sh_degree, views, *, refitted=0.0):
        return float(self._seen(self.missing(sh_degree), self.removed(splats, refitted=refitted), views))

    def removed(self, splats, *, refitted):
        """Return the error of removal if this number of splats is kept; `refitted` is the part of the gain, 0 to 1."""
        needed = self.splats - self.unneeded
        gone = np.maximum(0, needed - splats) / (0.5 * needed)
        return error_of(self.removal_psnr + self.mended * refitted) * gone**self.removal_power

    def missing(self, sh_degree):
        return float(error_of(self.shown[sh_degree])) if sh_degree < self.sh_degree else 0.0

    def _seen(self, error, removed, views):
        seen = (error + removed / error_of(views.removal_offset)) / error_of(views.offset)
        return seen if views.photo_psnr is None else seen + error_of(views.photo_psnr)

    # The reference, by trying everything.

    def smallest(self, psnr, views=DECIDING, *, no_prune=False):
        """Return the size of the smallest file of a PSNR; infinite if there is none."""
        sizes = [np.where(psnr_of(e) >= psnr, s, np.inf).min() for s, e in self._files(views, no_prune=no_prune)]
        return float(min(sizes))

    def best(self, size_bytes, views=DECIDING, *, no_prune=False):
        """Return the PSNR of the best file of a size; negative infinity if there is none."""
        found = [np.where(s <= size_bytes, psnr_of(e), -np.inf).max() for s, e in self._files(views, no_prune=no_prune)]
        return float(max(found))

    def _files(self, views, *, no_prune):
        """Yield sizes and errors of all qualities, for every number of splats, coding and degree."""
        shares = [1.0] if no_prune else np.arange(0.1, 1.001, 0.1)
        for share, coding in itertools.product(shares, ("scalar", "codebook", "none")):
            splats = round(share * self.splats)
            degrees = (0,) if coding == "none" else range(1, self.sh_degree + 1)
            for degree, entries in itertools.product(degrees, BOOKS if coding == "codebook" else (None,)):
                options = EncodeOptions(sh_coding=coding, sh_degree=degree, codebook_size=entries)
                for graded in {False, self.grading < 1.0}:
                    one = Contents(options, splats, refitted=splats < self.splats, graded=graded)
                    yield self.size_of(one, QUALITIES), self.error_of(one, views, QUALITIES)


@dataclass(frozen=True, eq=False)
class AnalyticFile:
    """A file of the computed size without content."""

    scene: AnalyticScene
    contents: Contents

    def __len__(self):
        return int(self.scene.size_of(self.contents))

    def psnr(self, views=DECIDING):
        return float(psnr_of(self.scene.error_of(self.contents, views)))


def search(
    scene, *, options=None, no_prune=False, judging=DECIDING, photo_psnr=None, grades=False, effort=3, tried=None,
    **target,
):  # fmt: skip
    """Search for a file that meets `Target(**target)`; return it, all that were tried or scored, and the report.

    Test views may have other errors (`judging`), images a PSNR of the source (`photo_psnr`, for a PSNR drop); `grades`
    allows quantisation classes, `effort` is that of a refit; `tried` receives the candidates even if the search fails.
    """
    model, asked, judge = scene.model(), Target(**target), _Judge(scene, judging)
    photographs = None if photo_psnr is None else _Judge(scene, Views(photo_psnr=photo_psnr))
    pool = CandidatePool(options or EncodeOptions(), _Judge(scene, DECIDING), decode=lambda data: data)
    removal = None if no_prune else analytic_removal(scene, grades=grades)
    whole = _Splats(scene, model, refits=False, classifiable=grades)
    goal, work = Goal.of(asked, model, photographs), SimplifyOptions(effort=effort).work
    try:
        best = TargetSearch(goal, pool, whole, removal, work).best()
    finally:
        if tried is not None:
            tried += [one.result.data for one in pool.made]
    report = make_report(
        asked, best, pool, judge, splats_before=scene.splats, views_of="virtual", remarks=(),
        encodes=len(pool.made), seconds=0.0,
    )  # fmt: skip
    files = [one.result.data for one in pool.made]
    return SimpleNamespace(file=best.result.data, tried=files, scored=judge.scored, report=report)


def analytic_removal(scene, *, grades=False):
    return _Removal(scene.model(), None, (48, 36), use_classes=grades, scene=scene)


@dataclass(eq=False)
class _Judge:
    """A scorer with the errors of the law, which records the files it scores."""

    scene: AnalyticScene
    views: Views
    cameras: tuple[int, ...] = tuple(range(8))
    scored: list[AnalyticFile] = field(default_factory=list)

    def errors(self, model):
        if isinstance(model, AnalyticFile):
            self.scored.append(model)
            error = self.scene.error_of(model.contents, self.views)
        else:
            refitted = float(model.sh0.max(initial=0.0))  # set by `_Removal.refit`
            error = self.scene.source_error(len(model), model.sh_degree, self.views, refitted=refitted)
        return np.full(len(self.cameras), error)

    def every(self, step):
        return replace(self, cameras=self.cameras[::step])

    def pooled(self, errors):
        return float(np.mean(errors))

    def psnr(self, model):
        return float(psnr_of(self.pooled(self.errors(model))))


@dataclass(eq=False)
class _Splats:
    """Splats of a file: a `Subset`."""

    scene: AnalyticScene
    model: SplatModel
    refits: bool
    classifiable: bool

    def encode(self, options, *, use_classes, draft):
        use_classes = use_classes and self.classifiable and options.max_classes != 1 and self.scene.grading != 1.0
        contents = Contents(options, len(self.model), self.refits, graded=use_classes, draft=draft and self.refits)
        chosen = self.scene.options_of(contents)
        largest = 10.0 ** (-chosen["quality"] / 20.0)  # error of the means; twice the mean one
        report = SimpleNamespace(
            options=chosen, errors={"means": (largest, 0.5 * largest)}, splat_count=contents.splats
        )
        return SimpleNamespace(write=lambda: SimpleNamespace(data=AnalyticFile(self.scene, contents), report=report))

    def lowered(self, degree):
        return drop_bands(self.model, degree)

    def metadata(self, validation_psnr):  # noqa: ARG002  # not recorded in the file
        return None


@dataclass
class _Order:
    scene: AnalyticScene

    def extend(self, **_):
        return False

    def mean_errors(self):
        return self.scene.removed(np.arange(self.scene.splats, 0, -1), refitted=False)

    def kept(self, count):
        return np.arange(self.scene.splats - count, self.scene.splats)


@dataclass(eq=False)
class _Removal(Pruner):
    scene: AnalyticScene = None

    @cached_property
    def order(self):
        return _Order(self.scene)

    def refit(self, kept_count, part=2.0):
        model = self.source.select(self.order.kept(kept_count))
        gain = self.scene.mended
        refitted = (gain - 1.5 * (part == 0.25)) / gain  # another refit gains 1.5 dB after a brief one
        model = replace(model, sh0=np.full_like(model.sh0, refitted))
        return _Splats(self.scene, model, refits=True, classifiable=self.use_classes)
