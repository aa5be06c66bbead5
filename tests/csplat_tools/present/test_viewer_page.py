# SPDX-License-Identifier: Apache-2.0
"""`csplat export-html`: one page that opens from a disk without a network and shows what the served one shows."""

import json
import re

import numpy as np
import pytest
from checked import cloud
from command_line import call

from csplat import CsplatError, encode, write_ply
from csplat_tools.present import viewer_page
from csplat_tools.present.viewer_page import PAGE, WORKER, export_page, link_modules, web_files
from csplat_tools.present.viewer_server import page_parameters
from csplat_tools.scene_files import MetadataOverrides


@pytest.fixture(scope="module")
def sample():
    """A file of 500 splats."""
    rng = np.random.default_rng(0)
    return encode(cloud(rng.standard_normal((500, 3)), 0.3, sh0=rng.standard_normal((500, 3)).astype(np.float32)))


@pytest.mark.slow
def test_the_command_puts_cameras_and_axes_into_the_page_or_a_pipe(sample, tmp_path):
    scene, cameras = tmp_path / "scene.csplat", tmp_path / "cameras.json"
    scene.write_bytes(sample)
    viewmat = np.eye(4)
    viewmat[2, 3] = 6.5
    entry = {"K": [[90, 0, 40], [0, 90, 30], [0, 0, 1]], "viewmat": viewmat.tolist(), "W": 80, "H": 60}
    cameras.write_text(json.dumps([entry]))
    call("export-html", scene, tmp_path / "page.html", "--cameras", cameras, "--up", "z")
    wishes = page_parameters(str(cameras), MetadataOverrides(up=(0.0, 0.0, 1.0)))
    assert {"camera", "up"} == set(wishes)
    assert export_page(sample, "scene.csplat", wishes).page == (tmp_path / "page.html").read_bytes()
    done = call("export-html", scene, "-", "--quiet")
    assert ("", export_page(sample, "scene.csplat").page) == (done.stderr, done.stdout_bytes)
    assert done.stdout_bytes.endswith(b"</html>\n")


def test_the_page_is_ascii_and_has_every_module_once(sample):
    exported = export_page(sample, "Gärtchen 🌷.csplat")
    assert len(exported.page) == exported.code_bytes + exported.scene_bytes
    assert abs(exported.scene_bytes / len(sample) - 4 / 3) < 0.001
    text = exported.page.decode("ascii")
    assert "<title>G&#228;rtchen &#127799;.csplat &#8211; csplat viewer</title>" in text
    assert '"name":"G\\u00e4rtchen \\ud83c\\udf37.csplat"' in text
    modules = {name for name in web_files() if name.endswith(".mjs")}
    paths = re.findall(r"^// (\S+\.mjs)\n\(link\) => \{$", text, re.MULTILINE)
    assert len(paths) == len(set(paths))
    assert {PAGE.replace("index.html", "main.mjs"), WORKER} < set(paths) <= modules
    assert not re.findall(r"^(?:import|export)\b.*", text, re.MULTILINE)
    assert "'self'" not in re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1]
    assert not re.findall(r'(?:src|href)="(?!data:)', text.partition('id="csplat-page"')[0])


GRAPH = {
    "a/main.mjs": "import { x } from './b.mjs';\nimport '../c/d.mjs';\nconst text = \"import y from './none.mjs'\";\n",
    "a/b.mjs": (
        "import {\n  one,\n  two as three,\n} from '../c/d.mjs';\nimport * as e from \"./e.mjs\";\n"
        "export {\n  e,\n  three as x,\n};\n"
    ),
    "a/e.mjs": "// import { x } from './none.mjs';\nexport async function* f() {}\nexport const from = 1;\n",
    "c/d.mjs": "/** @typedef {import('./none.mjs').T} T */\nexport const one = 1;\nexport class Two {}\n",
}


def test_modules_become_functions_behind_those_that_they_import():
    functions = link_modules(GRAPH, ["a/main.mjs"])
    assert ["c/d.mjs", "a/e.mjs", "a/b.mjs", "a/main.mjs"] == list(functions)
    bodies = [text.removeprefix(f"// {path}\n(link) => {{\n") for path, text in functions.items()]
    assert [
        "/** @typedef {import('./none.mjs').T} T */\nconst one = 1;\nclass Two {}\nreturn { one, Two };\n},\n",
        "// import { x } from './none.mjs';\nasync function* f() {}\nconst from = 1;\nreturn { f, from };\n},\n",
        "const {\n  one,\n  two: three,\n} = link(0);\nconst e = link(1);\n\nreturn { \n  e,\n  x: three };\n},\n",
        "const { x } = link(2);\nlink(0);\nconst text = \"import y from './none.mjs'\";\nreturn {  };\n},\n",
    ] == bodies


def test_modules_that_cannot_be_linked_are_refused():
    cannot = r"a\.mjs has a statement that cannot be linked: "
    for text, message in (
        ("import './b.mjs';", r"import each other: a\.mjs -> b\.mjs -> a\.mjs"),
        ("import './gone.mjs';", r"a\.mjs imports gone\.mjs, which does not exist"),
        ("export default 1;", cannot + "export default 1;"), ("export let n = 1;", cannot + "export let n = 1;"),
        ("export * from './b.mjs';", cannot + r"export \* from"), ("import a from './b.mjs';", cannot + "import a"),
    ):  # fmt: skip
        with pytest.raises(AssertionError, match=message):
            link_modules({"a.mjs": text, "b.mjs": "import './a.mjs';"}, ["a.mjs"])


def test_a_ply_is_encoded(make_model, tmp_path):
    write_ply(tmp_path / "scene.ply", make_model(50, 1))
    done = call("export-html", tmp_path / "scene.ply", tmp_path / "page.html")
    assert "encoded with the preset balanced" in done.stderr
    assert (tmp_path / "page.html").read_bytes().startswith(b"<!doctype html>")


def test_refusals_leave_the_page_unchanged(sample, sample_path, tmp_path):
    target, broken, middle = tmp_path / "page.html", tmp_path / "broken.csplat", len(sample) // 2
    target.write_text("mine")
    broken.write_bytes(sample[:middle] + bytes([sample[middle] ^ 1]) + sample[middle + 1 :])
    assert "--force replaces it" in call("export-html", sample_path, target, status=1).stderr
    assert "E_CRC" in call("export-html", broken, target, "--force", status=1).stderr
    call("export-html", sample_path, target, "--force", "--up", "w", status=2)
    assert "mine" == target.read_text()
    assert ["broken.csplat", "page.html"] == sorted(path.name for path in tmp_path.iterdir())


def test_an_incomplete_installation_is_an_error_of_its_own(monkeypatch, tmp_path):
    monkeypatch.setattr(viewer_page, "__file__", str(tmp_path / "a" / "b" / "viewer_page.py"))
    with pytest.raises(CsplatError, match="reinstall csplat"):
        export_page(b"", "scene.csplat")
