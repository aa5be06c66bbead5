# SPDX-License-Identifier: Apache-2.0
"""The encoder in JavaScript: its WebAssembly is that of the encoder in C, and its page converts a dropped PLY.

`codec/js-encoder/test` has the other tests.
"""

import base64
import shutil
import subprocess

import numpy as np
import pytest
from c_encoder import BUCKET_SPLATS, ROOT, SAMPLE, C, compiled, run
from chromium import absent

import csplat

pytestmark = pytest.mark.slow
in_depth = pytest.mark.long
ENCODER = ROOT / "codec" / "js-encoder"
PAGE = "/codec/js-encoder/example/index.html"
DROP = """([text]) => {
  const data = new DataTransfer();
  data.items.add(new File([Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0))], 'dropped.ply'));
  document.getElementById('target').dispatchEvent(new DragEvent('drop', { dataTransfer: data, bubbles: true }));
}"""
ENCODE = """
import { readFileSync, writeFileSync } from 'node:fs';
import { encodePly } from '%s';
writeFileSync(process.argv[2], (await encodePly(readFileSync(process.argv[1]))).file);
"""


def encoded(path, folder):
    """Return the bytes that Node and the tool in C make of a PLY."""
    node = shutil.which("node")
    if node is None:
        absent("node is not installed")
    program = ENCODE % (ENCODER / "encoder.mjs").as_uri()
    subprocess.run([node, "--input-type=module", "-e", program, path, folder / "js.csplat"], check=True)
    tool = compiled(folder, "encode", "-O2", C / "tools" / "encode.c")
    assert (0, "", "") == run(tool, path, "c.csplat", folder=folder)
    return (folder / "js.csplat").read_bytes(), (folder / "c.csplat").read_bytes()


def test_writes_the_bytes_of_the_encoder_in_c(tmp_path):
    ours, expected = encoded(SAMPLE, tmp_path)
    assert expected == ours


@in_depth
def test_writes_the_same_bytes_for_a_scene_of_several_buckets(tmp_path):
    rng = np.random.default_rng(2)
    model = csplat.read(SAMPLE, sh_degree=1)
    model = model.select(rng.integers(0, len(model), BUCKET_SPLATS + 1000))
    csplat.write_ply(tmp_path / "large.ply", model)
    ours, expected = encoded(tmp_path / "large.ply", tmp_path)
    assert expected == ours


@in_depth
def test_the_webassembly_is_compiled_from_these_sources(tmp_path):
    if shutil.which("clang-14") is None or shutil.which("wasm-ld-14") is None:
        absent("there is no clang-14 or no lld-14")
    subprocess.run([ENCODER / "wasm" / "build.sh", tmp_path / "wasm_binary.mjs"], cwd=ROOT, check=True)
    assert (ENCODER / "wasm_binary.mjs").read_bytes() == (tmp_path / "wasm_binary.mjs").read_bytes(), "make wasm"


@pytest.mark.browser
def test_the_page_converts_a_chosen_or_dropped_file_and_sends_nothing(tab, site, tmp_path):
    page, requests = tab.page, []
    page.on("request", lambda request: requests.append(request.method))
    page.goto(site.url(PAGE))
    page.set_input_files("#file", SAMPLE)
    tab.until("!document.getElementById('link').hidden")
    assert "Save sample.csplat" == page.inner_text("#link")
    with page.expect_download() as download:
        page.click("#link")
    download.value.save_as(tmp_path / "saved.csplat")
    assert len(csplat.read(SAMPLE)) == len(csplat.decode((tmp_path / "saved.csplat").read_bytes()))

    assert page.inner_text("#status").endswith(" MB.")

    broken = SAMPLE.read_bytes()[:-4] + np.float32(np.nan).tobytes()
    page.evaluate(DROP, [base64.b64encode(broken).decode()])
    tab.until("document.getElementById('link').textContent === 'Save dropped.csplat'")
    assert f" 1 of {len(csplat.read(SAMPLE)):,} splats are left out" in page.inner_text("#status")
    page.evaluate(DROP, [base64.b64encode(b"no PLY\n").decode()])
    tab.until("document.getElementById('problem').textContent !== ''")
    assert "dropped.ply: the file is no PLY" == page.inner_text("#problem")
    assert page.locator("#link").is_hidden()
    assert page.locator("#progress").is_hidden()
    assert {"GET"} == set(requests)
    assert all(path.startswith("/codec/js-encoder/") for path, _ in site.requests)
