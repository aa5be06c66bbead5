# SPDX-License-Identifier: Apache-2.0
"""Fixtures and hooks shared by several test files."""

import importlib
import math
import os
import pickle
import re
from pathlib import Path
from types import SimpleNamespace

import filelock
import hypothesis
import numpy as np
import pytest
from models import model_of

from csplat import _spec
from csplat.model import normalise_quats

ROOT = Path(__file__).resolve().parents[2]

# The machine may be busy, and a failure has to come again.
hypothesis.settings.register_profile("csplat", deadline=None, derandomize=True)
hypothesis.settings.load_profile("csplat")

SHARED = Path(os.environ.get("CSPLAT_DATA", ROOT.parent / "shared" / "data"))

#: External programs and files; CONTRIBUTING.md describes how to fill the folder.
PEERS = Path(os.environ.get("CSPLAT_PEERS", ROOT / "out" / "peers")).absolute()


def of_peers(name: str) -> Path:
    if not (PEERS / name).exists():
        pytest.skip(f"{name} is absent ({PEERS}); CSPLAT_PEERS names the folder of others, see CONTRIBUTING.md")
    return PEERS / name


#: Files with the longest tests: pytest-xdist starts them first, so that no worker is left with one at the end.
LONGEST = (
    "test_encoder_suite", "test_level_builder", "test_tradeoffs", "test_batch", "test_target_encoding",
    "test_viewer_pictures",
)  # fmt: skip

#: The marker of a file whose tests all have it.
OF_A_FILE = re.compile(r"^pytestmark = .*?\bpytest\.mark\.(\w+)", re.MULTILINE)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files whose marker is not selected: importing them takes two seconds, and torch as much again."""
    match = re.fullmatch(r"not \(([\w ]+)\).*", config.option.markexpr)
    if match is None or collection_path.suffix != ".py":
        return None
    marker = OF_A_FILE.search(collection_path.read_text(encoding="utf-8"))
    return True if marker and marker[1] in match[1].split(" or ") else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests with `data_dir` as shared_data and tests in Chromium as browser, and put the longest files first."""
    for item in items:
        fixtures = getattr(item, "fixturenames", ())
        if "data_dir" in fixtures:
            item.add_marker("shared_data")
        if "browser" in fixtures:
            item.add_marker("browser")
    ranks = {name: rank for rank, name in enumerate(LONGEST)}
    items.sort(key=lambda item: ranks.get(item.path.stem, len(ranks)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Report tests without shared scenes."""
    skipped = terminalreporter.stats.get("skipped", [])
    count = sum("shared_data" in getattr(one, "keywords", ()) for one in skipped)
    if count:
        terminalreporter.section(f"{count} tests skipped for lack of shared scenes", sep="=")
        terminalreporter.line(f"They are absent ({SHARED}); CSPLAT_DATA names their folder.")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of shared scenes, which are never part of the project."""
    if not SHARED.is_dir():
        pytest.skip(f"shared scenes are absent ({SHARED}); CSPLAT_DATA names their folder")
    return SHARED


@pytest.fixture(scope="session")
def once(tmp_path_factory):
    """Compute an expensive value once for all workers: `once("trained scene", make)`; the value must pickle."""
    folder = tmp_path_factory.getbasetemp()
    folder = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder

    def get(name, make):
        file = folder / f"{name.replace(' ', '-')}.pickle"
        with filelock.FileLock(f"{file}.lock"):
            if not file.exists():
                file.write_bytes(pickle.dumps(make()))
            return pickle.loads(file.read_bytes())  # noqa: S301  # written by a worker of the same run

    return get


@pytest.fixture(scope="session")
def sample_path() -> Path:
    return ROOT / "tools" / "csplat_tools" / "data" / "sample.ply"


@pytest.fixture(scope="session")
def spec() -> SimpleNamespace:
    """The pseudo-code of the specification, as functions."""
    from csplat_authoring.clauses import specification

    names = {
        "float64": np.float64, "float32": np.float32, "sqrt": np.sqrt, "ldexp": math.ldexp, "isfinite": np.isfinite,
        "floor": math.floor, "NO_PARENT": _spec.NO_PARENT, "bits": lambda x: int(np.float32(x).view(np.uint32)),
    }  # fmt: skip
    blocks = re.findall(r"```python spec-test\n(.*?)```", specification(), re.DOTALL)
    assert blocks
    for block in blocks:
        exec(block, names)  # noqa: S102 - the text is the project's own
    return SimpleNamespace(**names)


@pytest.fixture(scope="module")
def small_views():
    """Make virtual validation and test views small, for searches and reports whose figures are not asserted."""
    from csplat_tools.views.virtual_views import VirtualViewSizes

    small = VirtualViewSizes(test=(8, 160, 120), validation=(12, 80, 60), extra=(12, 80, 60))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("csplat_tools.views.virtual_views.VIRTUAL_SIZES", small)
        yield


@pytest.fixture
def little_level_work(monkeypatch):
    from csplat_tools.level_fitting import LevelFitter, Work

    work = Work(splats_to_measure=0.0, views=(8, 8), splats_to_move=0.0, steps=(5, 5))

    def fitter(*args, **options):
        return LevelFitter(*args, **{**options, "work": work})

    monkeypatch.setattr("csplat_tools.level_fitting.LevelFitter", fitter)


@pytest.fixture
def make_model():
    """Return a function for small random models: `make_model(count, degree, **fields)`."""

    def make(count=10, degree=3, seed=0, **fields):
        rng = np.random.default_rng(seed)

        def normal(*shape):
            return rng.standard_normal((count, *shape)).astype(np.float32)

        arrays = {
            "means": normal(3), "quats": normalise_quats(normal(4)), "scales": normal(3) - 4,
            "opacities": rng.random(count).astype(np.float32), "sh0": normal(3),
            "shN": normal((degree + 1) ** 2 - 1, 3),
        }  # fmt: skip
        return model_of(**{**arrays, **fields})

    return make


@pytest.fixture
def blender_set(tmp_path):
    from posed_sets import write_blender

    return write_blender(tmp_path)


@pytest.fixture
def transforms_set(tmp_path):
    from posed_sets import write_transforms

    return write_transforms(tmp_path)


@pytest.fixture
def colmap_set(tmp_path):
    from posed_sets import write_colmap_set

    return write_colmap_set(tmp_path)


@pytest.fixture
def colmap_text_set(tmp_path):
    from posed_sets import write_colmap_set

    return write_colmap_set(tmp_path, text=True)


@pytest.fixture(scope="session")
def captures():
    """The module captures.py, which trains and searches."""
    pytest.importorskip("PIL", reason="training requires the extra [render]")
    return importlib.import_module("captures")


@pytest.fixture(scope="session")
def trained_scene(once, captures, tmp_path_factory):
    return once("trained scene", lambda: captures.make_trained(tmp_path_factory.mktemp("trained")))


@pytest.fixture(scope="session")
def tuned_file(once, captures, trained_scene, tmp_path_factory):
    """A file of the trained scene, tuned for 100 steps; all workers share its files."""
    return once("tuned file", lambda: captures.make_tuned(tmp_path_factory.mktemp("tuned"), trained_scene))


@pytest.fixture(scope="session")
def search_at_psnr(once, captures):
    """The smallest file of `captures.crowded()` at 30 dB, by a real search."""
    return once("search at a psnr", lambda: captures.found_within(captures.crowded(), psnr=30.0))


@pytest.fixture(scope="session")
def search_at_size(once, captures):
    """The best file of `captures.crowded()` within 1,500 bytes, by a real search."""
    return once("search at a size", lambda: captures.found_within(captures.crowded(), size=1500))


@pytest.fixture(scope="session")
def search_at_loss(once, captures):
    """The smallest file of `captures.crowded()` that loses 0.5 dB against photographs of it."""
    scene = captures.crowded()
    find = captures.found_within
    return once("search at a loss", lambda: find(scene, captures.photographed(scene), max_psnr_drop=0.5))


@pytest.fixture(scope="session")
def file_runs(once, captures, tmp_path_factory):
    return once("file runs", lambda: captures.FileRuns(tmp_path_factory.mktemp("runs")))
