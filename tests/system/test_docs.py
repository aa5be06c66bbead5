# SPDX-License-Identifier: Apache-2.0
"""README and documentation: links resolve, figures are the measured ones, examples run.

Also: csplat_tools.inspect.file_report.
"""

import importlib
import itertools
import json
import re
import shlex
import tomllib
from pathlib import Path

import numpy as np
import pytest
from command_line import InThisProcess, call
from typer.main import get_command
from typer.testing import CliRunner

import csplat
from csplat import EncodeOptions, encode
from csplat_bench.pages import with_tables, write_pages
from csplat_render.camera import intrinsics, look_at
from csplat_render.camera_files import save_cameras
from csplat_tools import batch
from csplat_tools.cli.app import app

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "tools" / "docs"
README = (ROOT / "README.md").read_text("utf-8")
MEASURED = json.loads((DOCS / "measured.json").read_text("utf-8"))
EQUAL = re.compile(r"<li><b>(\S+): ([\d.]+) dB</b><br>([\d.]+) kB, ([\d,]+) splats</li>")
PRESETS = {row["name"]: row for row in MEASURED["rows"] if row["series"] == "preset"}


@pytest.fixture
def site(monkeypatch):
    monkeypatch.syspath_prepend(DOCS)
    return importlib.import_module("make_site")


def blocks(text, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def test_links_of_pages_lead_to_files_and_headings(site):
    for path in site.pages().values():
        for match in site.links((ROOT / path).read_text("utf-8")):
            if "://" in match[3]:
                continue
            target, anchor = site.target_of(path, match[3])
            if anchor:
                headings = re.findall(r"^#+ (.+)$", (ROOT / target).read_text("utf-8"), re.MULTILINE)
                assert anchor in {re.sub(r"[^\w\- ]", "", one.lower()).replace(" ", "-") for one in headings}
    with pytest.raises(FileNotFoundError, match=r"README\.md: nowhere\.md"):
        site.rewritten("see [this](nowhere.md)", "README.md")


def test_markdown_of_github_is_converted_for_the_site(site):
    text = "[a](../spec/format.md#1-scope), [b](js/decoder.d.ts), `[c](x.md)`, [d](https://example.org)"
    expected = "[a](format.md#1-scope), b, `[c](x.md)`, [d](https://example.org)"
    assert expected == site.rewritten(text, "codec/EMBEDDING.md")
    text = "Words:\n- one\n- two\n<!-- begin -->\n```python spec-test\n- x\n```\n"
    assert "Words:\n\n- one\n- two\n```python\n- x\n```\n" == site.for_python_markdown(text)


def test_the_navigation_contains_every_page(site):
    named = re.findall(r": ([\w-]+\.md)$", (DOCS / "mkdocs.yml").read_text("utf-8"), re.MULTILINE)
    assert sorted({*site.pages(), "commands.md", "python.md"}) == sorted(named)


@pytest.mark.slow
def test_the_readme_shows_measured_figures_of_this_encoder(sample_path):
    assert MEASURED["source"]["size_bytes"] == sample_path.stat().st_size
    for name, one in PRESETS.items():
        assert f"| `{name}` | {one['size_bytes']:,} | {one['psnr']:.1f} | {one['seconds']:.1f} |" in README
        size = len(csplat.encode(csplat.read(sample_path), csplat.EncodeOptions(name)))
        assert one["size_bytes"] == pytest.approx(size, rel=0.02)
    shown = PRESETS["balanced"]
    assert f"`csplat encode`: {shown['size_bytes'] / 1000:.0f} kB, {shown['psnr']:.1f} dB" in README


@pytest.mark.slow
def test_tables_and_plots_are_up_to_date(tmp_path):
    assert [] == write_pages(check=True), "run `python -m csplat_bench pages`"
    with pytest.raises(ValueError, match="table sizes is not declared"):
        with_tables("<!-- table: sizes -->\n<!-- end -->", {}, tmp_path)


def test_the_readme_of_the_package_has_no_relative_links():
    hook = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["hatch"]["metadata"]["hooks"]
    text = README
    for one in hook["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(one["pattern"], one["replacement"], text)
    assert text.startswith("# csplat\n")
    assert not re.search(r"\]\((?!https?:)", text)
    assert len(text) > 0.7 * len(README)


def test_commands_in_readme_and_guides_and_options_on_result_pages_are_valid():
    """Commands are parsed, not run, which reveals removed options."""
    group = get_command(app)
    commands = {name: group.get_command(None, name) for name in group.list_commands(None)}
    texts = [README, *(path.read_text("utf-8") for path in sorted((DOCS / "guide").glob("*.md")))]
    lines = [line for text in texts for block in blocks(text, "sh") for line in block.splitlines()]
    lines = [line.split("||")[0].strip() for line in lines if line.strip().startswith("csplat ")]
    assert len(lines) > 20
    for line in lines:
        name, *words = shlex.split(line, comments=True)[1:]
        commands[name].make_context(name, words, resilient_parsing=False)
    options = {option for command in commands.values() for parameter in command.params for option in parameter.opts}
    texts.append((ROOT / "codec" / "EMBEDDING.md").read_text("utf-8"))
    for name, words in re.findall(r"`csplat\s+(?!semantic)([a-z]\w*(?:-\w+)*)\b([^`]*)`", "\n".join(texts)):
        known = {option for parameter in commands[name].params for option in (*parameter.opts, "--help", "--help-all")}
        assert set() == set(re.findall(r"--[a-z][\w-]*", words)) - (options if name == "batch" else known), (
            name,
            words,
        )
    for path in (DOCS / "results").glob("*.md"):
        prose = re.sub(r"<!-- table.*?<!-- end -->", "", path.read_text("utf-8"), flags=re.DOTALL)
        words = " ".join(re.findall(r"`([^`]+)`", prose)).split()
        assert set() == {word for word in words if word.startswith("--")} - options, path.name


@pytest.mark.slow
def test_python_examples_run(sample_path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(batch, "ProcessPoolExecutor", InThisProcess)
    for folder in ("scenes", "encoded"):
        (tmp_path / folder).mkdir()
    for name in ("scene.ply", "scenes/one.ply"):
        csplat.write_ply(tmp_path / name, csplat.read(sample_path).select(range(200)))
    (tmp_path / "scenes" / "two.ply").write_bytes(b"not a PLY")
    names = {}
    exec(blocks(README, "python")[0], names)  # noqa: S102  # the README's own lines
    assert 200 == len(names["decoded"])
    exec(blocks((DOCS / "guide" / "batch.md").read_text("utf-8"), "python")[0], {"__name__": "__main__"})  # noqa: S102  # likewise
    one, two = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"scenes/one\.ply: \d+\.\d% of its size", one)
    assert two.startswith("scenes/two.ply: ")
    assert {"index.html", "one.csplat"} == {path.name for path in (tmp_path / "encoded").iterdir()}


@pytest.mark.slow
def test_the_python_example_with_levels_runs(sample_path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    csplat.write("scene.ply", csplat.read(sample_path))
    names = {}
    for program in blocks(README, "python"):
        exec(program, names)  # noqa: S102  # the README's own lines
    assert 0 < len(names["coarse"]) <= 5000
    assert 37.5 < float(capsys.readouterr().out.split()[0]) < 60.0


@pytest.mark.slow
@pytest.mark.usefixtures("small_views")
@pytest.mark.parametrize("page", [
    "tools/docs/guide/batch.md",
    "tools/docs/guide/formats.md",
    pytest.param("tools/docs/guide/levels.md", marks=pytest.mark.long),
    pytest.param("tools/docs/guide/smallest.md", marks=pytest.mark.long),
    pytest.param("README.md", marks=pytest.mark.long),
])  # fmt: skip
def test_the_commands_of_a_page_run_in_order(page, sample_path, tmp_path, monkeypatch):
    """On the sample as the city, and on a few of its splats as any other scene; orbits have fewer frames."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(batch, "ProcessPoolExecutor", InThisProcess)
    city = csplat.read(sample_path)
    few = city.select(range(0, len(city), 90))
    csplat.write("city.ply", city)
    given = (
        ("scene.spz", "capture.sog", "theirs.spz") if page.endswith("formats.md") else ("scene.ply", "scenes/one.ply")
    )
    (tmp_path / "scenes").mkdir()
    for name in given:
        csplat.write(name, few)
    if page.endswith("formats.md"):
        call("encode", "city.ply", "city.csplat", "--levels", "merged")
    lines = [
        shlex.split(line, comments=True)
        for block in blocks((ROOT / page).read_text("utf-8"), "sh")
        for line in block.splitlines()
    ]
    lines = [words[1:] for words in lines if words[0] == "csplat" and words[1] != "view"]
    assert len(lines) > 1
    for words in lines:
        call(*("3" if before == "--orbit" else word for before, word in itertools.pairwise(["", *words])), "--quiet")


@pytest.mark.long
def test_the_notebook_runs(tmp_path, monkeypatch):
    """Its cells run in order; the last line of each is its output."""
    pytest.importorskip("matplotlib").use("Agg")
    monkeypatch.chdir(tmp_path)
    cells = json.loads((DOCS / "guide" / "first-steps.ipynb").read_text("utf-8"))["cells"]
    names = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)  # noqa: S102  # the notebook's own lines
    assert 30.0 < names["compared"].psnr < names["compared"].ratio * 3
    assert len(names["coarse"]) < 4000
    assert {"small.csplat", "target.csplat"} == {path.name for path in tmp_path.iterdir()}


@pytest.mark.long
def test_formats_are_shown_at_equal_bytes(tmp_path, monkeypatch, sample_path):
    """With few splats, small images, and cameras on three sides."""
    monkeypatch.syspath_prepend(DOCS)
    model = csplat.read(sample_path).select(slice(0, None, 12))
    csplat.write_ply(tmp_path / "scene.ply", model)
    (tmp_path / "scene.csplat").write_bytes(encode(model, EncodeOptions(preset="fast")))
    K, centre = intrinsics(64, 48, 60.0), tuple(np.median(model.means, axis=0))
    places = (0.0, -1.0, -4.0), (4.0, -1.0, 0.0), (0.0, -1.0, 4.0)
    save_cameras(tmp_path / "cameras.json", [look_at(at, centre, (0.0, -1.0, 0.0), K, 64, 48) for at in places])
    names = [str(tmp_path / name) for name in ("scene.ply", "scene.csplat", "page.html")]
    monkeypatch.setattr("sys.argv", ["equal_bytes.py", *names, "--cameras", str(tmp_path / "cameras.json")])
    importlib.import_module("equal_bytes").main()
    found = {
        title: (float(psnr), float(size), int(splats.replace(",", "")))
        for title, psnr, size, splats in EQUAL.findall((tmp_path / "page.html").read_text("utf-8"))
    }
    assert ["PLY", "SPZ", ".csplat"] == list(found)
    csplat_psnr, csplat_size, count = found[".csplat"]
    assert count == len(model)
    for title, more in (("PLY", 1), ("SPZ", 3)):
        psnr, size, splats = found[title]
        assert 0.95 * csplat_size < size <= csplat_size + 0.1
        assert 10.0 < psnr < csplat_psnr
        assert more * 40 < splats < count


@pytest.mark.slow
@pytest.mark.usefixtures("small_views")
def test_the_tutorial_runs(tmp_path, monkeypatch):
    """Its commands run in order, with fewer and smaller images of a square, and fewer steps."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(ROOT / "tools" / "lab" / "sample")
    text = (DOCS / "guide" / "tutorial.md").read_text("utf-8")
    lines = [shlex.split(line) for block in blocks(text, "sh") for line in block.splitlines()]
    numbers = {"--views": "3", "--size": "16", "--iterations": "6", "--max-splats": "50"}
    first, *others = [[numbers.get(before, word) for before, word in itertools.pairwise(["", *line])] for line in lines]
    assert ["python", "tools/lab/sample/make_sample.py"] == first[:2]
    make_sample = importlib.import_module("make_sample")
    monkeypatch.setattr(make_sample, "photograph", square)
    make_sample.main(first[2:])
    for words in others:
        result = CliRunner().invoke(app, [*words[1:], "--quiet"])
        assert 0 == result.exit_code, (words, result.output, result.exception)
    made = {"photographs", "garden.ply", "garden.csplat", "garden.html", "about.html", "back.ply"}
    assert made == {path.name for path in tmp_path.iterdir()}


def square(_garden, camera):
    pixels = np.zeros((camera.H, camera.W, 4), np.uint8)
    pixels[camera.H // 3 : -camera.H // 3, camera.W // 3 : -camera.W // 3] = (200, 120, 40, 255)
    return pixels, np.random.default_rng(0).uniform(-0.5, 0.5, (camera.H, camera.W, 3))
