# SPDX-License-Identifier: Apache-2.0
"""The packed npm packages in a user's project: types, and pages of Vite, webpack, esbuild and Next.js, in Chromium."""

import json
import re
import shutil
import subprocess
import tarfile
import tempfile
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

import pytest
from chromium import absent

from csplat import EncodeOptions, encode
from csplat.ply import read_ply
from csplat_bench.browser import serve
from csplat_bench.subjects.engine_images import settled_image

pytestmark = [pytest.mark.slow, pytest.mark.engines]
ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / "tools" / "examples" / "bundlers"
PACKAGES = ("js", "js-encoder")
QUIET = ("--silent", "--ignore-scripts", "--no-audit", "--no-fund")


@pytest.fixture(scope="module")
def project():
    """The example and half a gigabyte from the registry, which stay in the folder for temporary files."""
    npm = shutil.which("npm") or absent("the bundlers come from npm, which is not installed")
    folder = Path(tempfile.gettempdir()) / "csplat-bundlers"
    manifest, installed = (EXAMPLE / "package.json").read_text("utf-8"), folder / "installed.json"
    shutil.copytree(EXAMPLE, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("node_modules", "dist", ".next"))
    packed = [
        json.loads(subprocess.check_output([npm, "pack", "--json", ROOT / "codec" / name], cwd=folder))[0]
        for name in PACKAGES
    ]
    if not installed.exists() or installed.read_text("utf-8") != manifest:
        (folder / "package-lock.json").unlink(missing_ok=True)
        done = subprocess.run([npm, "install", *QUIET], cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            absent(f"npm cannot install the bundlers: {done.stderr.strip()[:200]}")
        installed.write_text(manifest, "utf-8")
    for package in packed:  # npm takes a package of a version that is installed for the same
        target = folder / "node_modules" / package["name"]
        shutil.rmtree(target)
        with tarfile.open(folder / package["filename"]) as archive:
            archive.extractall(folder, filter="data")
        (folder / "package").rename(target)
    return folder


def run(folder, *words):
    done = subprocess.run(
        [shutil.which("npm"), "run", "--silent", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert 0 == done.returncode, done.stdout + done.stderr


@contextmanager
def built(folder, name, files):
    """Build the pages with a bundler, and serve them with some files."""
    if name == "next":
        (folder / "public").mkdir(exist_ok=True)
        shutil.rmtree(folder / ".next", ignore_errors=True)
    else:
        (folder / "dist").mkdir(exist_ok=True)
    run(folder, name)
    target = folder / ("public" if name == "next" else f"dist/{name}")
    for path in files:
        shutil.copy(path, target)
    if name != "next":
        if name != "vite":
            page = (folder / "index.html").read_text("utf-8")
            (target / "index.html").write_text(page.replace("main.ts", "main.js" if name == "webpack" else "main.mjs"))
        with serve(target) as address:
            yield address
        return
    words = [shutil.which("node"), "node_modules/next/dist/bin/next", "start", "--hostname", "127.0.0.1", "--port", "0"]
    with subprocess.Popen(words, cwd=folder, stdout=subprocess.PIPE, text=True) as server:
        try:
            yield (
                next(match[0] for line in server.stdout if (match := re.search(r"http://127\.0\.0\.1:\d+", line))) + "/"
            )
        finally:
            server.terminate()


@pytest.fixture(scope="module")
def scenes(tmp_path_factory, sample_path):
    folder = tmp_path_factory.mktemp("scenes")
    (folder / "scene.csplat").write_bytes(encode(read_ply(sample_path), EncodeOptions(preset="fast")))
    shutil.copy(sample_path, folder / "scene.ply")
    return [folder / "scene.csplat", folder / "scene.ply"]


def test_the_types_are_strict(project):
    run(project, "types")
    words = "--noEmit --strict --skipLibCheck false --target es2022 --module esnext --moduleResolution bundler"
    done = subprocess.run(
        [shutil.which("node"), "node_modules/typescript/bin/tsc", *words.split(), "main.ts"],
        cwd=project, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "" == done.stdout


@pytest.mark.parametrize("name", ["vite", "webpack", "esbuild", "next"])
def test_a_page_draws_a_scene_and_encodes_a_ply_in_workers(project, scenes, browser, sample_path, name):
    count = len(read_ply(sample_path))
    with built(project, name, scenes) as address:
        if name == "next":
            assert b"<canvas" in urlopen(address).read()  # noqa: S310  # our own server: it has rendered the page
        for file, workers in (("scene.csplat", 1), ("scene.ply", 2)):
            page = browser.new_page(viewport={"width": 320, "height": 240})
            started, problems = [], []
            page.on("worker", lambda worker, started=started: started.append(worker.url))
            page.on("pageerror", lambda error, problems=problems: problems.append(str(error)))
            page.goto(f"{address}?scene={file}")
            page.wait_for_function("document.title !== '.csplat'", timeout=120_000)
            assert f"{count} splats" == page.title()
            image = settled_image(page)
            assert 0.05 < ((image.max(axis=2) > 0.15) & (image.min(axis=2) < 0.85)).mean() < 0.95
            assert workers <= len(started), started
            assert [] == problems
            page.close()


# The page of the example for PlayCanvas, as a project without bundler has it.
PLAYCANVAS = """<!doctype html><link rel="icon" href="data:,"><canvas></canvas><p id="words"></p>
<script type="importmap">
{"imports": {"playcanvas": "/node_modules/playcanvas/build/playcanvas.mjs",
  "playcanvas/scripts/": "/node_modules/playcanvas/scripts/", "csplat-decoder/playcanvas": "./csplat-parser.mjs"}}
</script><script type="module" src="playcanvas.mjs"></script>"""


def test_one_script_for_playcanvas_draws_a_scene(project, scenes, browser):
    run(project, "playcanvas")
    folder = project / "dist" / "playcanvas"
    script = (folder / "csplat-parser.mjs").read_text("utf-8")
    assert ["playcanvas"] == re.findall(r'(?:from|^import|;import)\s*"([^"]+)"', script)
    (folder / "index.html").write_text(PLAYCANVAS, "utf-8")
    shutil.copy(EXAMPLE.parent / "playcanvas.mjs", folder)
    shutil.copy(scenes[0], folder)
    page = browser.new_page(viewport={"width": 320, "height": 240})
    requests = []
    page.on("request", lambda request: requests.append(request.url.rpartition("/")[2]))
    with serve(project) as address:
        page.goto(f"{address}dist/playcanvas/index.html")
        image = settled_image(page)
        assert "" == page.inner_text("#words")
    assert 0.1 < (image.max(axis=2) > 0.15).mean() < 0.9
    assert [] == [name for name in requests if name.endswith((".wasm", "decoder.mjs"))]
    page.close()
