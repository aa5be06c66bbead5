"""The guide for implementers: its code runs, and its example has the numbers in the text."""

import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from csplat_conformance.declared_bounds import Source
from csplat_conformance.encoders.reference_ply import PlyRows, source_of_rows

ROOT = Path(__file__).resolve().parent.parent
GUIDE = (ROOT / "conformance" / "IMPLEMENTERS.md").read_text(encoding="utf-8").replace("−", "-")
SPEC = (ROOT / "spec" / "format.md").read_text(encoding="utf-8")
LEVELS, ALPHAS, MEAN_STEP, SCALE_STEP, SH0_STEP = 127, 63, 0.01, 1 / 16, 1 / 64


@pytest.fixture(scope="module")
def spec():
    """The spec's pseudo-code."""
    names = {"float64": np.float64, "float32": np.float32, "sqrt": np.sqrt, "ldexp": math.ldexp, "floor": math.floor}
    for block in re.findall(r"```python spec-test\n(.*?)```", SPEC, re.DOTALL):
        exec(block, names)  # noqa: S102 - the text is the project's own
    return SimpleNamespace(**names)


@pytest.fixture(scope="module")
def row():
    """A function: the numbers of the row of the example that begins so, a list for each splat."""
    part = GUIDE.split("### Stating errors")[1].split("So SERR states")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in part.splitlines() if line[:1] == "|"]
    table = {cells[0]: [re.findall(r"-?\d+(?:\.\d+)?", cell) for cell in cells[1:]] for cells in rows}

    def numbers(name):
        return [[float(number) for number in cell] for cell in table[name]]

    return numbers


@pytest.fixture(scope="module")
def source(row) -> Source:
    columns = {
        "means": row("x, y, z"),
        "quats": row("rot_0 … rot_3"),
        "scales": row("scale_0 … scale_2"),
        "logits": [value for (value,) in row("opacity")],
        "sh0": row("f_dc_0 … f_dc_2"),
    }
    arrays = {name: np.array(values, np.float32) for name, values in columns.items()}
    return source_of_rows(PlyRows(**arrays, shN=np.zeros((2, 0, 3), np.float32)))


@pytest.fixture(scope="module")
def file(spec, row):
    """Decode the integers of the guide's example with the functions of the guide."""
    colours = [spec.rgb_from_ycocg(*map(int, one), 0) for one in row("sh0, integers Y, Co, Cg")]
    lattice = lambda rows, step: np.array(  # noqa: E731
        [[spec.lattice_value(int(n), step, 0) for n in one] for one in rows], np.float32
    )
    return SimpleNamespace(
        origin=np.zeros(3),
        means=lattice(row("means, integers"), MEAN_STEP),
        scales=lattice(row("scales, integers"), SCALE_STEP),
        quats=np.array([spec.quat(*map(int, one), LEVELS) for one in row("quats, integers")]),
        opacities=[spec.opacity_square(int(q), ALPHAS) for (q,) in row("opacities, integer")],
        sh0=lattice(colours, SH0_STEP),
    )


def near(expected, found):
    np.testing.assert_allclose(np.array(found, np.float64), np.array(expected), rtol=0, atol=6e-8)


def test_the_source_is_what_the_rows_say(row, source):
    near(row("quaternion of the source"), source.quats)
    near(row("alpha of the source"), source.opacities[:, None])


def test_the_integers_are_those_of_annex_e(spec, row, source):
    for j in range(2):
        turned = spec.with_w_largest(*map(float, source.quats[j]))
        near(row("with w largest")[j] or row("quaternion of the source")[j], turned)
        assert row("quats, integers")[j] == spec.quat_integers(turned, LEVELS)
        steps = [float(value) / SH0_STEP for value in source.sh0[j]]
        assert row("sh0, integers Y, Co, Cg")[j] == list(spec.ycocg_from_rgb(*steps, 0))
        assert row("means, integers")[j] == [math.floor(float(v) / MEAN_STEP + 0.5) for v in source.means[j]]
        assert row("scales, integers")[j] == [math.floor(float(v) / SCALE_STEP + 0.5) for v in source.scales[j]]
        assert row("opacities, integer")[j] == [math.floor(math.sqrt(float(source.opacities[j])) * ALPHAS + 0.5)]


def test_the_values_are_what_a_decoder_gives(row, file):
    near(row("decoded quaternion"), file.quats)
    near(row("decoded alpha"), [[alpha] for alpha in file.opacities])
    near(row("decoded sh0"), file.sh0)


def test_the_code_of_the_guide_states_what_the_guide_says(row, source, file):
    code = re.search(r"### Stating errors.*?```python\n(.*?)```", GUIDE, re.DOTALL)[1]
    names = {"source": source, "file": file}
    exec(code, names)  # noqa: S102 - the text is the project's own
    for j in range(2):
        for name, values in names["errors"](j, j):
            near(row(f"error of {name}")[j], values)
    part = GUIDE.split("So SERR states")[1].split("## ")[0]
    table = dict(re.findall(r"^\| (\w+) \| ([\d.]+ \| [\d.]+) \|", part, re.MULTILINE))
    for name, pair in names["stated"]([0, 1]).items():
        near([float(number) for number in table[name].split(" | ")], pair)
