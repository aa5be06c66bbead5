# SPDX-License-Identifier: Apache-2.0
"""Building of the compiled library, the wheels with and without it, and the library under sanitizers."""

import os
import platform
import runpy
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from csplat_render import kernels

ROOT = Path(__file__).resolve().parents[3]
SOURCES = ROOT / "trainer" / "csplat_render" / "native"
SAMPLE = ROOT / "tools" / "csplat_tools" / "data" / "sample.ply"
LEAST = ("build.py", "library.cpp", "library.h", "threads.h")
#: Tests that reach the functions of the library, for sanitizers.
THOROUGH = (
    "test_kernels.py",
    "test_rasteriser.py",
    "test_metric_kernels.py",
    "test_neighbours.py",
    "test_nearest_entries.py",
)

#: Scripts that print a digest of results.
DIGESTS = ("csplat_trainer/test_losses.py",)

in_depth = pytest.mark.long


def run(*words, cwd=None, **variables):
    environment = {**os.environ, **{name: value for name, value in variables.items() if value is not None}}
    return subprocess.run(
        [sys.executable, *map(str, words)], capture_output=True, text=True, check=False, cwd=cwd, env=environment
    )


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project with the sources of the functions about the library alone, and the hook that compiles them."""
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.delenv("CSPLAT_NATIVE", raising=False)
    folder = tmp_path / "trainer" / "csplat_render" / "native"
    folder.mkdir(parents=True)
    for name in LEAST:
        shutil.copy(SOURCES / name, folder)
    hook = runpy.run_path(ROOT / "tools" / "release" / "build_hook.py")["NativeBuildHook"]
    return SimpleNamespace(
        folder=folder,
        build=SimpleNamespace(**runpy.run_path(folder / "build.py")),
        hook=hook(str(tmp_path), {}, None, None, str(tmp_path), "wheel"),
        data={"force_include": {}, "pure_python": True},
    )


@pytest.fixture
def compiler(project):
    """A compiler; a machine without one lends pip that of a package, in an environment that pip removes."""
    return project.build.compiler() or pytest.skip("compiles, by a C++ compiler or the package ziglang")


@pytest.mark.slow
@pytest.mark.usefixtures("compiler")
def test_a_library_is_compiled_when_its_sources_change(project):
    files = project.build.build()
    assert [] == project.build.requirements()
    assert set(kernels.INSTRUCTION_SETS) >= {path.stem.removeprefix("csplat_native_") for path in files}
    before = [path.stat().st_mtime_ns for path in files]
    assert files == project.build.build()
    assert before == [path.stat().st_mtime_ns for path in files]
    with (project.folder / "threads.h").open("a") as source:
        source.write("// changed\n")
    assert not project.build.is_current()
    assert files == project.build.build()
    assert all(old < path.stat().st_mtime_ns for old, path in zip(before, files, strict=True))


@pytest.mark.slow
@pytest.mark.usefixtures("compiler")
def test_a_library_exports_its_functions_alone(project):
    nm = shutil.which("nm")
    if nm is None or sys.platform != "linux":
        pytest.skip("lists symbols of Linux by nm")
    for path in project.build.build():
        listed = subprocess.check_output([nm, "-D", "--defined-only", "--format=just-symbols", path], text=True)
        assert ["csplat_forget_threads", "csplat_supported"] == sorted(listed.split())


@pytest.mark.slow
@pytest.mark.usefixtures("compiler")
def test_the_wheel_with_the_library_serves_every_python_of_its_platform(project):
    project.hook.initialize("standard", project.data)
    assert project.data["tag"] == f"py3-none-{project.build.wheel_platform()}"
    assert not project.data["pure_python"]
    assert {f"csplat_render/native/{path.name}" for path in project.build.build()} == {
        *project.data["force_include"].values()
    }


def test_the_hook_compiles_nothing_if_it_is_off(project, monkeypatch):
    before = dict(project.data)
    monkeypatch.setenv("CSPLAT_NATIVE", "off")
    assert [] == project.hook.dependencies()
    project.hook.initialize("standard", project.data)
    assert before == project.data
    assert sorted(LEAST) == sorted(path.name for path in project.folder.iterdir())


def test_the_hook_refuses_unknown_values(project, monkeypatch, capfd):
    monkeypatch.setenv("CSPLAT_NATIVE", "on")
    for call in (project.hook.dependencies, lambda: project.hook.initialize("standard", project.data)):
        with pytest.raises(SystemExit):
            call()
        assert "CSPLAT_NATIVE is 'on', expected auto, require, off" in capfd.readouterr().err


def test_a_compiler_that_fails_is_an_error_only_if_the_library_is_required(project, monkeypatch, capfd):
    before = dict(project.data)
    monkeypatch.setenv("CXX", "false")
    project.hook.initialize("standard", project.data)
    assert before == project.data
    assert "csplat is built without its compiled renderer" in capfd.readouterr().err
    monkeypatch.setenv("CSPLAT_NATIVE", "require")
    with pytest.raises(SystemExit):
        project.hook.initialize("standard", project.data)
    assert "ended with status 1" in capfd.readouterr().err


def test_a_machine_without_a_compiler_takes_that_of_a_package(project, monkeypatch):
    monkeypatch.setenv("PATH", str(project.folder))
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    build = SimpleNamespace(**runpy.run_path(project.folder / "build.py"))
    assert [build.ZIG] == build.requirements() == project.hook.dependencies()
    with pytest.raises(build.BuildError, match="there is no C\\+\\+ compiler: install one, or the package 'ziglang"):
        build.build()


@in_depth
def test_the_wheel_without_the_library_encodes_decodes_and_refuses_to_render(tmp_path):
    built = run("-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path, ROOT, CSPLAT_NATIVE="off")
    assert 0 == built.returncode, built.stdout + built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name.endswith("-py3-none-any.whl")
    with zipfile.ZipFile(wheel) as archive:
        assert ["csplat_render/native/__init__.py"] == [name for name in archive.namelist() if "native" in name]
        archive.extractall(tmp_path / "site")

    def csplat(*words):
        return run("-m", "csplat_tools", *words, cwd=tmp_path, PYTHONPATH=str(tmp_path / "site"))

    for words in (("encode", SAMPLE, "a.csplat"), ("verify", "a.csplat"), ("decode", "a.csplat", "a.ply")):
        ended = csplat(*words)
        assert 0 == ended.returncode, ended.stderr
    ended = csplat("compare", SAMPLE, "a.csplat")
    line = (
        "error: this installation of csplat has no compiled renderer: install a wheel for this platform, or a C++ "
        "compiler and csplat again (E_INPUT)\n"
    )
    assert (1, line) == (ended.returncode, ended.stderr)


@in_depth
@pytest.mark.skipif(platform.machine() != "x86_64", reason="compares vectors of x86-64 with portable ones")
def test_portable_vectors_give_the_same_bits():
    folder, sets = ROOT / "out" / "portable", ("avx512", "avx2", "portable")
    built = run(SOURCES / "build.py", folder, "--sets", ",".join(sets))
    assert 0 == built.returncode, built.stderr
    for script in DIGESTS:
        found = {}
        for name in sets:
            variables = {kernels.FOLDER_VARIABLE: str(folder), kernels.SET_VARIABLE: name}
            ended = run(ROOT / "tests" / script, PYTHONPATH=str(ROOT / "tests" / "helpers"), **variables)
            if "expected one that this installation and processor have" not in ended.stderr:
                assert 0 == ended.returncode, ended.stderr
                found[name] = ended.stdout
        assert len(found) > 1
        assert {found["portable"]} == {*found.values()}, script


@in_depth
@pytest.mark.skipif(sys.platform != "linux", reason="loads the runtime of GCC's sanitizers on Linux")
@pytest.mark.parametrize(("kinds", "runtime"), [("address,undefined", "libasan.so"), ("thread", "libtsan.so")])
def test_sanitizers_find_nothing(kinds, runtime):
    folder = ROOT / "out" / "sanitized" / kinds
    built = run(SOURCES / "build.py", folder, "--sanitize", kinds)
    assert 0 == built.returncode, built.stderr
    library = subprocess.check_output([shutil.which("c++"), f"-print-file-name={runtime}"], text=True).strip()
    words = ["-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider", "-m", "not long and not torch"]
    words += ["-k", "not forked"]  # the thread sanitizer does not follow forks
    ended = run(
        *words, *(ROOT / "tests" / "csplat_render" / name for name in THOROUGH), cwd=ROOT,
        CSPLAT_NATIVE_FOLDER=str(folder), LD_PRELOAD=library, PYTHONMALLOC="malloc", OPENBLAS_NUM_THREADS="1",
        ASAN_OPTIONS="detect_leaks=0", TSAN_OPTIONS="halt_on_error=1", UBSAN_OPTIONS="print_stacktrace=1",
    )  # fmt: skip
    assert 0 == ended.returncode, ended.stdout + ended.stderr
