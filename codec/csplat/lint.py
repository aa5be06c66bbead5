# SPDX-License-Identifier: Apache-2.0
"""Describe findings about splat files: unusual or invalid content and its repair.

A *note* is ordinary variation; nothing looks different. A *repair* changes or drops data safely; `strict` refuses it.
An *error* cannot be repaired without guessing. A *loss* is detected while writing: the target cannot hold part of the
scene. What a reader leaves out is in `lost` of a note or repair; `convert` lists it, and `--no-loss` refuses it.

| id | meaning | kind |
|---|---|---|
| `missing-columns` | a required column is absent | error |
| `sh-columns` | f_rest columns that match no SH degree up to 4, or are not numbered from 0 | error |
| `repeated-names` | two elements, or two columns of one, with the same name | error |
| `ambiguous-columns` | two columns with the same meaning under other programs' names | error |
| `colour-columns` | red, green and blue that are neither bytes nor in 0 to 1 | error |
| `integer-columns` | integers instead of floats | error |
| `colour-space` | ml-sharp colours that are not sRGB | error |
| `truncated` | fewer splats than the header declares | error |
| `malformed` | a row that cannot be parsed, or binary rows changed by a text-mode transfer | error |
| `trailing-bytes` | bytes after the last declared splat: ignored | repair |
| `list-columns` | list properties of splats: dropped | repair |
| `other-elements` | contents that are not splats, such as elements of PLY, meshes, extensions: dropped | repair |
| `nonfinite-rows` | splats with NaN or infinity: dropped; an error if no splats remain | repair |
| `zero-quats` | rotations of length 0: replaced by the identity | repair |
| `unnormalised-quats` | rotations that are not of unit length: normalised, as in every renderer | note |
| `infinite-logits` | opacities of exactly 0 or 1 | note |
| `zero-scales` | log scales of -infinity, which are sizes of 0: read as flat | note |
| `one-scale` | one scale instead of three: spheres, which may have no rotations | note |
| `packed-colours` | three bytes of colour in a row, of which the header declares one (nerfstudio) | note |
| `flat-scales` | two scales instead of three: discs (2DGS) | note |
| `extra-columns` | columns that splats do not have: dropped unless extra columns are kept | note |
| `double-columns` | attributes in doubles: rounded to float32 | note |
| `nonzero-normals` | normals that differ, which splats do not use: dropped | note |
| `huge-values` | log scales beyond ± 88, colours beyond ± 1e6 | note |
| `shuffled-columns` | columns in an unusual order | note |
| `alias-columns` | columns under another program's names: CloudCompare's `scalar_opacity` | note |
| `second-columns` | duplicates of columns that exist under the usual name, which is read | note |
| `rgb-colours` | red, green and blue instead of f_dc: read as colours of SH degree 0 | note |
| `filter-3d` | the 3D filter of Mip-Splatting: fused into scales and opacities, or left out | note, repair |
| `sh-bands` | SH bands above the requested degree: dropped | note |
| `vertical-axis` | a comment names the up axis | note |
| `opacities-are-alphas` | opacities all in 0 to 1 or 255, probably alpha; read as logits | note |
| `scales-are-linear` | scales that fit the scene as lengths, not as logarithms; read as logarithms | note |
| `colours-are-rgb` | f_dc all in 0 to 1 or 0 to 255, probably colours; read as SH coefficients | note |
| `half-floats` | columns of 16-bit integers whose bits are half floats: read as half floats | note |
| `sharp-elements` | elements of ml-sharp other than the splats: dropped | note |
| `unusual-header` | a byte order mark, blank lines or capitals in the header | note |
| `unusual-rows` | text rows with blank lines, decimal commas, other spellings of NaN, or unusual line breaks | note |
| `ranks` | gsplat checkpoints: the splats of one GPU or of several are read | note |
| `zip-names` | backslashes or capitals in the names in a SOG's zip or manifest | note |
| `levels` | coarser levels of detail in a .csplat file: one level is read | note |
| `colour-space`, `projection` | a .csplat file of others than csplat draws: drawn as sRGB, in perspective | note |
| `other-scenes` | more scenes than the one that is read, in a SOG's zip or in glTF without a default scene | note |
| `double-means` | positions in doubles or integers: an origin keeps their precision | note |
| `non-ascii-header` | names outside ASCII, or comments outside UTF-8, in the header: read as question marks | note |
| `zero-rows` | splats of .splat and .ksplat whose bytes are all 0: kept | note |
| `empty` | no splats at all | note |
| `log-scales` | scales that should be standard deviations, most of them negative: read as logarithms | repair |
| `negative-scales` | other scales below 0: the sign is ignored; an error if the format forbids them | repair, error |
| `logit-opacities` | opacities that should lie in 0..1, many far outside: read as logits | repair |
| `out-of-range-opacities` | other opacities outside 0..1: clipped; an error beyond -1 and 2 | repair, error |
| `linear-colours` | colours in linear light (glTF): fitted to sRGB, with the error of the fit | repair |
| `unclear-scales` | no scale is negative, but the program is known to write logarithms (glTF) | note |
| `spz-axes` | SPZ in glTF along other axes than its extension names | note |
| `short-buffer` | a buffer of glTF is shorter than declared, but holds all splats | note |
| `lost-contents` | parts of the scene that the target format does not have: SH bands, axes, metadata | loss |
| `clamped-values` | values of an attribute beyond the range of the target format: clamped | loss |
| `moved-splats` | positions that the target format rounds by more than the size of their splats | loss |
| `filling-splats` | invisible splats that fill chunks of a compressed PLY, so that far splats have their own | loss |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from csplat.errors import InputError, counted
from csplat.model import MAX_SH_DEGREE

_NAMES_MAX, _NAME_MAX = 6, 40  # names in a list, characters of a name

FindingKind = Literal["note", "repair", "error", "loss"]


@dataclass(frozen=True)
class Finding:
    """A finding about a file.

    Attributes:
        id: id in the table above, stable across versions.
        count: number of splats, columns, elements or bytes affected.
        text: a line that describes the finding and its treatment.
        kind: `note`, `repair`, `error` or `loss`.
        usual: True if most trained scenes have the finding; it is shown only if all findings are requested.
        attribute: name of the array concerned; "" if none.
        largest_error: largest difference from the source among the values of the attribute; `None`: unknown.
        lost: the contents of the file that its reader leaves out, in a few words each.
    """

    id: str
    count: int
    text: str
    kind: FindingKind
    usual: bool = False
    attribute: str = ""
    largest_error: float | None = None
    lost: tuple[str, ...] = ()

    @property
    def repairable(self) -> bool:
        """True if the file can be read."""
        return self.kind != "error"

    def __str__(self) -> str:
        return f"{self.kind}: {self.id}: {self.text}"


def trailing_bytes(count: int) -> list[Finding]:
    """Return the finding for bytes after the last splat, if there are any."""
    what = f"{counted(count, 'byte')} after the last splat"
    return [Finding("trailing-bytes", count, f"{what}: ignored", "repair", lost=(what,))] if count > 0 else []


def list_names(names: Sequence[str]) -> str:
    """Join names from a file for messages: the first few, shortened, with question marks for control characters."""
    shown = ["".join(c if c.isprintable() else "?" for c in name[:_NAME_MAX]) for name in names[:_NAMES_MAX]]
    more = len(names) - len(shown)
    return ", ".join(shown) + (f" and {more:,} more" if more else "")


def other_contents(contents: Sequence[str]) -> list[Finding]:
    """Return the finding for contents that are not splats, in a few words each, if there are any."""
    text = f"besides the splats: {', '.join(contents)}: dropped"
    return [Finding("other-elements", len(contents), text, "repair", lost=tuple(contents))] if contents else []


def too_many_bands(degree: int) -> str:
    """Return the error message for a file with more SH bands than a model, with the options that drop them."""
    bands = f"band {degree}" if degree == MAX_SH_DEGREE + 1 else f"bands {MAX_SH_DEGREE + 1} to {degree}"
    return (
        f"SH degree {degree}, expected at most {MAX_SH_DEGREE}: --sh-degree {MAX_SH_DEGREE} of csplat encode, convert,"
        f" finetune, lint and render, or sh_degree={MAX_SH_DEGREE} of csplat.read, leaves {bands} out"
    )


def refuse(findings: Sequence[Finding], *, strict: bool) -> None:
    """Refuse a file with errors or, if `strict`, with repairs.

    Raises:
        InputError: the message lists all errors and refused repairs.
    """
    refused = [finding for finding in findings if finding.kind == "error" or (strict and finding.kind == "repair")]
    if refused:
        raise InputError("; ".join(f"{finding.id}: {finding.text}" for finding in refused))
