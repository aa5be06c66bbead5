"""The decoder in C: it compiles without a warning, passes the conformance suite, and its example runs."""

from __future__ import annotations

import re
import shutil
import subprocess
from contextlib import contextmanager
from pathlib import Path

import pytest
from chromium import absent

import csplat_conformance
from csplat_conformance import protocol
from csplat_conformance.decoder_suite import DecoderSuiteOptions, run_command
from csplat_conformance.protocol import ProcessEnd

ROOT = Path(__file__).resolve().parents[2]
C = ROOT / "codec" / "c"
VECTORS = Path(csplat_conformance.__file__).parent / "vectors"
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
COMPILER = shutil.which("cc")
SANITIZED = ("-g", "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.fixture(autouse=True, scope="module")
def _compiler():
    if COMPILER is None or run([COMPILER, "-E", "-include", "zlib.h", "-"], input="").returncode:
        absent("there is no C compiler, cc, or no zlib.h")


def run(command, **options):
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def compiled(folder, name, *arguments):
    """Compile a program; return its path."""
    libraries = () if "-c" in arguments else ("-lz", "-lm")
    made = run([COMPILER, *STRICT, f"-I{C}", *map(str, arguments), "-o", str(folder / name), *libraries])
    assert (made.returncode, made.stderr) == (0, "")
    return folder / name


@pytest.fixture(scope="module")
def decoder(tmp_path_factory):
    """The decoder that inflates with zlib; some warnings need optimisation."""
    return compiled(tmp_path_factory.mktemp("c"), "csplat.o", "-c", "-O1", C / "csplat.c")


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory):
    """The decoder and its inflate with sanitizers, which take some seconds to compile."""
    folder = tmp_path_factory.mktemp("sanitized")
    return [
        compiled(folder, f"{name}.o", "-c", *SANITIZED, "-DCSPLAT_NO_ZLIB", C / f"{name}.c")
        for name in ("csplat", "inflate")
    ]


@contextmanager
def asked(adapter):
    """One process for all files: the runner starts one for each, and starting the sanitizers takes most of the time."""
    with (
        pytest.MonkeyPatch.context() as monkeypatch,
        subprocess.Popen([str(adapter)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process,
    ):

        def run_program(_command, places, _timeout, **_):
            process.stdin.write(f"{places['input']}\n{places['outdir']}\n")
            process.stdin.flush()
            line = process.stdout.readline()
            assert line, f"the adapter ended at {places['input']}: status {process.wait()}"
            return ProcessEnd(None, line != "{}\n", line.encode(), b"", 0.0)

        monkeypatch.setattr(protocol, "run_program", run_program)
        yield
        process.stdin.close()
        assert process.wait() == 0  # AddressSanitizer found no leak


#: With sanitizers, or another compiler: it runs when a source in C changes.
in_depth = pytest.mark.long


def assert_passes(adapter):
    with asked(adapter):
        report = run_command("adapter {input} {outdir}", DecoderSuiteOptions(jobs=1))
    assert report.failures == []
    assert len(report.outcomes) > 1000
    assert not [note for note in report.notes if "unread" in note]


@pytest.mark.slow
def test_passes_the_conformance_suite(tmp_path):
    sources = [C / "csplat.c", C / "inflate.c", C / "tools" / "adapter.c"]
    assert_passes(compiled(tmp_path, "adapter", "-DCSPLAT_NO_ZLIB", *sources))


@pytest.mark.slow
def test_selects_the_tiles_of_cuts(decoder, tmp_path):
    adapter = compiled(tmp_path, "adapter", decoder, C / "tools" / "adapter.c")
    options = DecoderSuiteOptions("valid/levels*,extreme/levels*", levels=(5,))
    report = run_command(None, options, cuts=f"{adapter} --cuts {{input}} {{cuts}}")
    assert report.failures == []
    assert len(report.outcomes) > 10


@in_depth
@pytest.mark.slow
def test_passes_the_conformance_suite_under_sanitizers(sanitized, tmp_path):
    assert_passes(compiled(tmp_path, "adapter", *SANITIZED, *sanitized, C / "tools" / "adapter.c"))


@pytest.mark.slow
def test_reads_and_refuses_the_same_streams_by_zlib(decoder, tmp_path):
    with asked(compiled(tmp_path, "adapter", decoder, C / "tools" / "adapter.c")):
        report = run_command("adapter {input} {outdir}", DecoderSuiteOptions("*deflate*,valid/rich", jobs=1))
    assert report.failures == []
    assert len(report.outcomes) > 50


@in_depth
@pytest.mark.slow
def test_survives_callers_whose_functions_fail(sanitized, tmp_path):
    interface = compiled(tmp_path, "interface", *SANITIZED, *sanitized, C / "tools" / "interface.c")
    for name in ("rich", "levels_of_the_rich_scene"):
        ended = run([interface, VECTORS / "valid" / f"{name}.csplat"])
        assert (ended.returncode, ended.stderr) == (0, "")


@in_depth
@pytest.mark.slow
def test_the_webassembly_of_the_javascript_decoder_is_compiled_from_these_sources(tmp_path):
    if shutil.which("clang-14") is None or shutil.which("wasm-ld-14") is None:
        absent("there is no clang-14 or no lld-14")
    made = run(["codec/js/wasm/build.sh", tmp_path / "wasm_binary.mjs"], cwd=ROOT)
    assert (made.returncode, made.stderr) == (0, "")
    committed = (ROOT / "codec" / "js" / "wasm_binary.mjs").read_bytes()
    assert (tmp_path / "wasm_binary.mjs").read_bytes() == committed, "make wasm"


@pytest.mark.slow
def test_the_example_prints_the_contents_of_a_file(decoder, tmp_path):
    example = compiled(tmp_path, "example", decoder, C / "example.c")
    told = subprocess.run(
        [example, VECTORS / "valid" / "worked_example.csplat"], capture_output=True, text=True, check=True
    )
    assert '2 splats, SH degree 1, 1 tile, axes RDF\n{"title":"two"}\n' in told.stdout
    refused = run([example, VECTORS / "invalid" / "chunk_crc.csplat"])
    assert refused.returncode == 1
    assert re.fullmatch(r"E_CRC at byte \d+ \(CHK-1\): .+\n", refused.stderr)


@pytest.mark.slow
def test_the_sample_of_the_guide_decodes(decoder, tmp_path):
    sample = (ROOT / "codec" / "EMBEDDING.md").read_text(encoding="utf-8").split("```c\n")[1].split("```")[0]
    source = tmp_path / "sample.c"
    source.write_text(
        '#include "csplat.h"\n#include <stdio.h>\n'
        "static float means[196608], quats[262144], scales[196608], opacities[65536], sh0[196608], shN[4718592];\n"
        "static int fail(const char *message)\n{\n    return puts(message);\n}\n"
        "int main(void)\n{\nstatic char data[4096];\nsize_t size = fread(data, 1, sizeof data, stdin);\n"
        f'{sample}return printf("%g %g", (double)quats[0], (double)shN[0]) != 3;\n}}\n',
        encoding="utf-8",
    )
    program = compiled(tmp_path, "sample", decoder, source)
    with (VECTORS / "valid" / "worked_example.csplat").open("rb") as file:
        assert run([program], stdin=file).stdout == "1 1"
