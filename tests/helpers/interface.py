# SPDX-License-Identifier: Apache-2.0
"""The lists of API.md, made from the code: names, members, parameters, options, and keys of reports.

    python tests/helpers/interface.py    # write them into API.md, below its promise

A test compares them with the code, so that no change of the interface goes unnoticed.
"""

from __future__ import annotations

import inspect
import json
import re
import textwrap
from collections.abc import Iterable, Iterator
from importlib import import_module
from itertools import groupby
from pathlib import Path
from types import ModuleType
from typing import Any

import typer

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "API.md"
BEGIN = "<!-- made by tests/helpers/interface.py -->\n"
PACKAGES = ("csplat", "csplat_render", "csplat_trainer", "csplat_tools")
#: Entries of the npm packages, and their declarations.
MODULES = {
    "csplat-decoder": "codec/js/decoder.d.ts",
    "csplat-decoder: options and results of all loaders": "codec/js/engines/options.d.ts",
    "csplat-decoder/three": "codec/js/engines/three.d.ts",
    "csplat-decoder/spark": "codec/js/engines/spark.d.ts",
    "csplat-decoder/playcanvas": "codec/js/engines/playcanvas.d.ts",
    "csplat-decoder/babylon": "codec/js/engines/babylon.d.ts",
    "csplat-encoder": "codec/js-encoder/encoder.d.ts",
    "the script of `csplat export-element`": "tools/viewer/types.d.ts",
}
#: Members that other packages use, and that are not promised.
INTERNAL = {
    "Batch": "as_json select",
    "Context": "folder is_bounded memory_limit thread_count",
    "DataSet": "inliers outliers read report trained_on",
    "EncodeOptions": "chosen kept_degree",
    "EncodeResult": "content rows with_notes with_search",
    "FinetuneOptions": "has_calmed learning_rate_factor scaled",
    "Scene": "changed empty has_doubles in_memory keep_open like loaded modified_ns numbered of reader with_progress",
    "SceneMetadata": "semantic_of stated_up",
    "SimplifyOptions": "pruner views_and_size work",
    "SplatModel": "means_double",
    "Target": "as_json count is_rendered require size_bytes",
    "TrainOptions": (
        "active_degree growth_from is_half_size learning_rates prunings_left refine_begin refine_end refine_period "
        "refines_after sh_every"
    ),
    "TuningViews": "digest",
    "ViewSet": (
        "image_test_scorer image_validation_scorer images_of origin read_images test_background test_scorer "
        "validation_scorer"
    ),
}
INTERNAL["SplatFile"] = INTERNAL["Scene"] + " pieces window"
#: Keys of reports whose members are not promised.
DIAGNOSTIC = ("chosen", "codings", "coders", "encoding", "entries", "log", "metadata", "options", "quantiles", "tried")
HEADERS = ("codec/c/csplat.h", "codec/c/csplat_encode.h")
WIDTH = 130  # characters per line


def page() -> str:
    """Return API.md with lists made from the code."""
    promise, _, _ = PAGE.read_text("utf-8").partition(BEGIN)
    parts = [
        ("Python", "".join(_package(name) for name in PACKAGES) + _results()),
        ("JavaScript", "".join(_module(name, ROOT / path) for name, path in MODULES.items()) + _element()),
        ("C", "".join(_header(ROOT / path) for path in HEADERS)),
        ("Command line", "".join(_commands())),
        ("Keys of `--json`", "".join(_reports())),
    ]
    return promise + BEGIN + "".join(f"\n## {title}\n{text}" for title, text in parts)


def _list(title: str, entries: Iterable[str]) -> str:
    """Return a paragraph: a title in bold, and entries in backticks, wrapped."""
    words = ", ".join(f"`{entry}`" for entry in entries)
    return "\n" + textwrap.fill(f"**{title}** {words}", WIDTH, break_long_words=False, break_on_hyphens=False) + "\n"


def _package(name: str) -> str:
    package = import_module(name)
    return _list(name, (_python_entry(one, getattr(package, one)) for one in sorted(package.__all__)))


def _python_entry(name: str, value: Any) -> str:
    """Return `name(parameters)` of a function, `name{members}` of a class, and the name of anything else."""
    if inspect.isclass(value):
        members = sorted(_members(value))
        return f"{name}{{{','.join(members)}}}" if members else name
    if inspect.isfunction(value):
        return f"{name}({','.join(inspect.signature(value).parameters)})"
    return name


def _members(value: type) -> dict[str, str]:
    """Return the promised members of a class, with the annotation of what each is or returns."""
    annotations = {
        name: str(text) for one in reversed(value.__mro__) for name, text in inspect.get_annotations(one).items()
    }
    members = {one for one in {*dir(value), *annotations} if not one.startswith("_") and one not in dir(Exception)}
    found = {}
    for one in members - set(INTERNAL.get(value.__name__, "").split()):
        member = inspect.getattr_static(value, one, None)
        code = getattr(member, "fget", None) or getattr(member, "func", None) or getattr(member, "__func__", member)
        found[one] = annotations.get(one) or str(getattr(code, "__annotations__", {}).get("return", ""))
    return found


def _results() -> str:
    """Return the classes that no package exports: results of its functions, members of its classes, and `FitStep`."""
    packages = [import_module(package) for package in PACKAGES]
    exported = {name: getattr(package, name) for package in packages for name in package.__all__}
    defined = {name: module for package in packages for name, module in _definitions(package)}
    found = {"FitStep": defined["FitStep"]}
    for value in exported.values():
        is_class = inspect.isclass(value)
        texts = _members(value).values() if is_class else [getattr(value, "__annotations__", {}).get("return")]
        near = vars(import_module(getattr(value, "__module__", "csplat")))
        for word in re.findall(r"\w+", " ".join(map(str, texts))):
            if word in defined and word not in exported and inspect.isclass(near.get(word, type)):
                found[word] = getattr(near.get(word), "__module__", defined[word])
    classes = {name: getattr(import_module(module), name) for name, module in sorted(found.items())}
    return _list("results of these", (_python_entry(name, value) for name, value in classes.items()))


def _definitions(package: ModuleType) -> Iterator[tuple[str, str]]:
    """Yield the classes in the sources of a package, with their modules, whether or not these can be imported."""
    folder = Path(package.__path__[0])
    for path in sorted(folder.rglob("*.py")):
        module = ".".join([package.__name__, *path.relative_to(folder).with_suffix("").parts]).removesuffix(".__init__")
        yield from ((name, module) for name in re.findall(r"(?m)^class (\w+)", path.read_text("utf-8")))


def _module(title: str, path: Path) -> str:
    """Return the exported names of a TypeScript declaration, classes and interfaces with their members."""
    text = re.sub(r"/\*.*?\*/|//[^\n]*", "", path.read_text("utf-8"), flags=re.DOTALL)
    found: dict[str, set[str]] = {}
    for match in re.finditer(r"^export (?:declare )?(?:interface|class|type|function|const) (\w+)", text, re.MULTILINE):
        body = re.split(r"^[}]|^export |^declare ", text[match.end() :], maxsplit=1, flags=re.MULTILINE)[0]
        members = re.findall(r"^  (?:(?:readonly|static|get|set|declare) )*(\w+)\??[(:<]", body, re.MULTILINE)
        found.setdefault(match[1], set()).update(members if match[0].split()[-2] in ("interface", "class") else ())
    for names in re.findall(r"^export type \{([^}]*)\}", text, re.MULTILINE):
        found |= {name: set() for name in re.findall(r"\w+", names)}
    entries = (f"{name}{{{','.join(sorted(members))}}}" if members else name for name, members in sorted(found.items()))
    return _list(title, entries)


def _element() -> str:
    """Return the attributes, events and parts of `<csplat-view>`."""
    element = (ROOT / "tools" / "viewer" / "element.mjs").read_text("utf-8")
    wishes = re.search(r"const WISHES = \[(.*?)\]", element, re.DOTALL)
    observed = re.search(r"observedAttributes = \[(.*?)\]", element, re.DOTALL)
    assert wishes
    assert observed
    attributes = sorted(set(re.findall(r"'([\w-]+)'", observed[1] + wishes[1])))
    events = sorted(set(re.findall(r"#tell\('(\w+)'", element)))
    parts = sorted(set(re.findall(r"part: '(\w+)'", element)))
    return (
        _list("`<csplat-view>`, attributes", attributes)
        + _list("`<csplat-view>`, events", events)
        + _list("`<csplat-view>`, parts", parts)
    )


def _header(path: Path) -> str:
    """Return the functions, types with their members, and constants of a header in C."""
    text = re.sub(r"/\*.*?\*/|//[^\n]*", "", path.read_text("utf-8"), flags=re.DOTALL)
    entries = []
    for kind, name, body in re.findall(r"typedef (enum|struct) (\w+) (?:\{(.*?)\} )?\w+;", text, re.DOTALL):
        members = re.findall(r"\b([A-Z][A-Z0-9_]+)\b", body) if kind == "enum" else _fields(body)
        entries.append(f"{name}{{{','.join(members)}}}" if members else name)
    entries += [f"{name}()" for name in re.findall(r"^[a-z][\w *]*?\b(csplat_\w+)\(", text, re.MULTILINE)]
    entries += re.findall(r"^#define (CSPLAT_\w+) ", text, re.MULTILINE)
    return _list(path.name, entries)


def _fields(body: str) -> list[str]:
    """Return the names of the members of a struct: the last word of each declarator, or a function pointer's."""
    names = []
    for line in body.split(";"):
        pointer = re.search(r"\(\*(\w+)\)", line)
        names += [pointer[1]] if pointer else re.findall(r"\**(\w+)(?:\[[^\]]*\])*\s*(?:,|$)", line.strip())
    return names


_COMMON = {"--force", "--report", "--json", "--quiet", "-q", "--help-all"}
_COMPLETION = {"--install-completion", "--show-completion"}  # typer's


def _commands() -> Iterator[str]:
    from csplat_tools.cli.app import app

    group = typer.main.get_command(app)
    yield _list("every command", sorted(_COMMON))
    for name, command in _walk(group, ""):
        words = [
            word
            for parameter in command.params
            for word in (
                [parameter.name.upper()]
                if parameter.param_type_name == "argument"
                else sorted(parameter.opts + parameter.secondary_opts, reverse=True)
            )
        ]
        common = _COMMON if "--help-all" in words else set()
        yield _list(f"csplat {name}".strip(), [word for word in words if word not in common | _COMPLETION])


def _walk(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield commands with their names, groups before what is in them."""
    yield name, command
    for one in command.list_commands(None) if hasattr(command, "list_commands") else ():
        yield from _walk(command.get_command(None, one), f"{name} {one}".strip())


def _reports() -> Iterator[str]:
    """Yield the keys of each report, from the snapshot of behaviour; with an option, the keys that it adds."""
    recorded = json.loads((ROOT / "tests" / "system" / "behaviour.json").read_text("utf-8"))["keys"]
    for name, keys in recorded.items():
        plain = set(recorded.get(name.partition(" --")[0], ())) if " --" in name else set()
        yield _list(name, _folded(sorted(tuple(key.split(".")) for key in set(keys) - plain)))


def _folded(keys: list[tuple[str, ...]]) -> Iterator[str]:
    """Yield keys with the same beginning as one entry, `a{b,c{d}}`; neighbours with the same members as `a/b{c}`."""
    entries = []
    for first, same in groupby(keys, lambda key: key[0]):
        inner = [key[1:] for key in same if len(key) > 1] if first.removesuffix("[]") not in DIAGNOSTIC else []
        entries.append((first, ",".join(_folded(inner))))
    for members, group in groupby(entries, lambda entry: entry[1]):
        names = [first for first, _ in group]
        if members:
            yield f"{'/'.join(names)}{{{members}}}"
        else:
            yield from names


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
