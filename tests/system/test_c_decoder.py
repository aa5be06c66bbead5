# SPDX-License-Identifier: Apache-2.0
"""The decoder in C: it compiles without a warning, passes the conformance suite, and its example runs."""

import os
import re
import shlex
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

pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[2]
C = ROOT / "codec" / "c"
DECODER, INFLATE, ADAPTER = C / "csplat.c", C / "inflate.c", C / "tools" / "adapter.c"
VECTORS = Path(csplat_conformance.__file__).parent / "vectors"
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
OWN_INFLATE = ("-DCSPLAT_NO_ZLIB", DECODER, INFLATE)
SANITIZED = ("-g", "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", *OWN_INFLATE)
COMPILER = shutil.which("cc")
in_depth = pytest.mark.long  # with sanitizers, or another compiler


@pytest.fixture(autouse=True, scope="module")
def _compiler():
    if COMPILER is None or run([COMPILER, "-E", "-include", "zlib.h", "-"], input="").returncode:
        absent("there is no C compiler, cc, or no zlib.h")


def run(command, **options):
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


def compiled(folder, name, *arguments):
    libraries = () if "-c" in arguments else ("-lz", "-lm")
    made = run([COMPILER, *STRICT, f"-I{C}", *map(str, arguments), "-o", str(folder / name), *libraries])
    assert (0, "") == (made.returncode, made.stderr)
    return folder / name


@pytest.fixture(scope="module")
def decoder(tmp_path_factory):
    """The decoder that inflates with zlib; some warnings need optimisation."""
    return compiled(tmp_path_factory.mktemp("c"), "csplat.o", "-c", "-O1", DECODER)


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
        assert 0 == process.wait()  # AddressSanitizer found no leak


@pytest.mark.parametrize(("sources", "choice", "least"), [
    (OWN_INFLATE, {}, 1000),
    ((DECODER,), {"pattern": "*deflate*,valid/rich"}, 50),
    pytest.param(SANITIZED, {}, 1000, marks=in_depth),
], ids=["inflate.c", "zlib", "sanitizers"])  # fmt: skip
def test_passes_the_conformance_suite(tmp_path, sources, choice, least):
    with asked(compiled(tmp_path, "adapter", *sources, ADAPTER)):
        report = run_command("adapter {input} {outdir}", DecoderSuiteOptions(jobs=1, **choice))
    assert [] == report.failures == [note for note in report.notes if "unread" in note]
    assert len(report.outcomes) > least


def test_selects_the_tiles_of_cuts(decoder, tmp_path):
    adapter = compiled(tmp_path, "adapter", decoder, ADAPTER)
    options = DecoderSuiteOptions("valid/levels*,extreme/levels*", levels=(5,))
    report = run_command(None, options, cuts=f"{shlex.quote(str(adapter))} --cuts {{input}} {{cuts}}")
    assert [] == report.failures
    assert len(report.outcomes) > 10


@in_depth
def test_survives_callers_whose_functions_fail(tmp_path):
    interface = compiled(tmp_path, "interface", *SANITIZED, C / "tools" / "interface.c")
    for name in ("rich", "levels_of_the_rich_scene"):
        ended = run([interface, VECTORS / "valid" / f"{name}.csplat"])
        assert (0, "") == (ended.returncode, ended.stderr)


@in_depth
def test_the_webassembly_of_the_javascript_decoder_is_compiled_from_these_sources(tmp_path):
    if shutil.which("clang-14") is None or shutil.which("wasm-ld-14") is None:
        absent("there is no clang-14 or no lld-14")
    made = run(["codec/js/wasm/build.sh", tmp_path / "wasm_binary.mjs"], cwd=ROOT)
    assert (0, "") == (made.returncode, made.stderr)
    committed = (ROOT / "codec" / "js" / "wasm_binary.mjs").read_bytes()
    assert committed == (tmp_path / "wasm_binary.mjs").read_bytes(), "make wasm"


def test_the_example_prints_the_contents_of_a_file(decoder, tmp_path):
    example = compiled(tmp_path, "example", decoder, C / "example.c")
    told = run([example, VECTORS / "valid" / "worked_example.csplat"])
    assert '2 splats, SH degree 1, 1 tile, axes RDF\n{"title":"two"}\n' in told.stdout
    refused = run([example, VECTORS / "invalid" / "chunk_crc.csplat"])
    assert (0, 1) == (told.returncode, refused.returncode)
    assert re.fullmatch(r"E_CRC at byte \d+ \(CHK-1\): .+\n", refused.stderr)


# What the samples of the page about C take as given.
GIVEN = """
#include "csplat.h"
#include "csplat_encode.h"
#include <stdio.h>
#include <stdlib.h>
csplat *file; csplat_error error; csplat_options *options; csplat_source source; csplat_floats floats; csplat_tile tile;
csplat_scene *scene; csplat_packed_geometry geometry; csplat_packed packed; csplat_columns columns; csplat_ply ply;
csplat_declared_errors errors; const csplat_node *nodes; csplat_cut cut; int found; const char *text; void **extras;
uint32_t i, count, *tiles; unsigned degree, band; uint16_t id; void *data; size_t size;
float *sh, *means, *quats, *scales, *opacities, *sh0, *shN;
"""


def test_the_samples_of_the_page_compile(tmp_path):
    page = (C / "README.md").read_text(encoding="utf-8")
    calls, cut, encoding = (block.split("```")[0] for block in page.split("```c\n")[1:])
    bodies = (calls, cut, f"uint8_t *file;\n{encoding}")
    functions = [f"int sample{number}(void)\n{{\n{body}return 0;\n}}\n" for number, body in enumerate(bodies)]
    (tmp_path / "samples.c").write_text("\n".join([GIVEN, *functions]), encoding="utf-8")
    made = run([COMPILER, "-std=c99", "-Wall", "-Werror", f"-I{C}", "-fsyntax-only", tmp_path / "samples.c"])
    assert (0, "") == (made.returncode, made.stderr)


@in_depth
def test_the_lines_of_the_page_run(tmp_path):
    shutil.copytree(C, tmp_path / "c")
    shutil.copy(VECTORS / "valid" / "worked_example.csplat", tmp_path / "c" / "scene.csplat")
    page = (C / "README.md").read_text(encoding="utf-8")
    example, library = (block.split("```")[0] for block in page.split("```sh\n")[1:])
    told = run(["sh", "-c", example], cwd=tmp_path / "c")
    assert (0, "") == (told.returncode, told.stderr)
    assert "2 splats, SH degree 1" in told.stdout
    if shutil.which("cmake") is None:
        absent("there is no cmake")
    made = run(["sh", "-c", library], cwd=tmp_path / "c", env={**os.environ, "DESTDIR": str(tmp_path / "installed")})
    assert 0 == made.returncode, made.stderr
    assert {"csplat.h", "csplat.pc"} <= {path.name for path in (tmp_path / "installed").rglob("*")}


@pytest.mark.parametrize(("options", "zlib"), [
    (["-DBUILD_SHARED_LIBS=OFF"], True),
    (["-DBUILD_SHARED_LIBS=ON", "-DCMAKE_DISABLE_FIND_PACKAGE_ZLIB=ON"], False),
], ids=["zlib", "absent"])  # fmt: skip
def test_a_project_of_cmake_finds_the_library(tmp_path, options, zlib):
    if shutil.which("cmake") is None:
        absent("there is no cmake")

    def cmake(*arguments):
        made = run(["cmake", *map(str, arguments)])
        assert 0 == made.returncode, made.stdout + made.stderr

    prefix, project, alias = tmp_path / "prefix", tmp_path / "project", tmp_path / "alias"
    cmake("-S", C, "-B", tmp_path / "c", "-DCMAKE_BUILD_TYPE=Debug", f"-DCMAKE_INSTALL_PREFIX={prefix}", *options)
    cmake("--build", tmp_path / "c", "--target", "install")
    assert zlib == ("find_dependency(ZLIB)" in next(prefix.rglob("csplatConfig.cmake")).read_text("utf-8"))
    lines = (C / "README.md").read_text("utf-8").split("```cmake\n")[1].split("```")[0]
    project.mkdir()
    shutil.copy(C / "example.c", project / "main.c")
    head = "cmake_minimum_required(VERSION 3.14)\nproject(app C)\n"
    (project / "CMakeLists.txt").write_text(head + lines, "utf-8")
    cmake("-S", project, "-B", project, f"-DCMAKE_PREFIX_PATH={prefix}")
    cmake("--build", project)
    told = run([project / "app", VECTORS / "valid" / "rich.csplat"])
    assert (0, "") == (told.returncode, told.stderr)
    alias.mkdir()
    shutil.copy(C / "example.c", alias / "main.c")
    inside = re.sub("find_package.*", f'add_subdirectory("{C}" c)', lines)
    (alias / "CMakeLists.txt").write_text(head + inside, "utf-8")
    cmake("-S", alias, "-B", alias, *options)  # a name with :: that is no target is an error


def test_the_sample_of_the_guide_decodes(decoder, tmp_path):
    sample = (ROOT / "codec" / "EMBEDDING.md").read_text(encoding="utf-8").split("```c\n")[1].split("```")[0]
    (tmp_path / "sample.c").write_text(
        '#include "csplat.h"\n#include <stdio.h>\n'
        "static float means[196608], quats[262144], scales[196608], opacities[65536], sh0[196608], shN[4718592];\n"
        "static int fail(const char *message)\n{\n    return puts(message);\n}\n"
        "int main(void)\n{\nstatic char data[4096];\nsize_t size = fread(data, 1, sizeof data, stdin);\n"
        f'{sample}return printf("%g %g", (double)quats[0], (double)shN[0]) != 3;\n}}\n',
        encoding="utf-8",
    )
    program = compiled(tmp_path, "sample", decoder, tmp_path / "sample.c")
    with (VECTORS / "valid" / "worked_example.csplat").open("rb") as file:
        assert "1 1" == run([program], stdin=file).stdout
