# SPDX-License-Identifier: Apache-2.0
"""Export the viewer, the JavaScript decoder and a scene as one HTML page, or the viewer as one script.

A page opened as `file:` cannot import modules from neighbouring files, and its worker cannot import at all: the origin
of such a page equals no other, not even the origin of its own blobs. So the modules become functions of one classic
script. The page runs it, and so does the worker, which is made from a blob of the same text: a function can read its
own source. A policy in the page forbids the network. The page is ASCII, so that the text matches the digests in the
policy even if a server declares another charset.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import posixpath
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from csplat.errors import InputError

#: Paths below the root: the page, the element for other pages, and the module of their worker.
PAGE = "tools/viewer/index.html"
ELEMENT = "tools/viewer/element.mjs"
WORKER = "tools/viewer/worker.mjs"

_FOLDERS = {"tools/viewer": (".html", ".css", ".mjs"), "codec/js": (".mjs",), "codec/js/levels": (".mjs",)}


def web_files() -> dict[str, Path]:
    """Return the files that the page may load, by their paths below the root, such as `tools/viewer/index.html`.

    Raises:
        InputError: the installation is incomplete.
    """
    package = Path(__file__).resolve().parent.parent  # csplat_tools
    for root in (package / "web", package.parent.parent):  # an installed wheel, a checkout
        if (root / PAGE).is_file():
            return {
                f"{folder}/{path.name}": path
                for folder, endings in _FOLDERS.items()
                for path in sorted((root / folder).iterdir())
                if path.suffix in endings
            }
    raise InputError("the viewer is not installed: reinstall csplat")


# Import statements: `import { a, b as c } from '…'`, `import * as a from '…'`, `import '…'`.
_IMPORT = re.compile(
    r"""^import\s+(?:(?:\*\s+as\s+(?P<all>[\w$]+)|(?P<some>\{[^}]*\}))\s+from\s+)?(['"])(?P<name>[^'"\n]+)\3;""",
    re.MULTILINE,
)
# Export statements: of a declaration, and `export { a, b as c };`.
_DECLARED = re.compile(r"^export\s+(?=(?:const|class|(?:async\s+)?function\s*\*?)\s+(?P<name>[\w$]+))", re.MULTILINE)
_LISTED = re.compile(r"^export\s+\{(?P<names>[^}]*?),?\s*\};", re.MULTILINE)
_STATEMENT = re.compile(r"^(?:import|export)\b.*", re.MULTILINE)
# What is left out of files by their type: comments, in modules also types, comments behind a statement (if no quote
# follows, as in an address in a string), indentation and empty lines, also of GLSL and WGSL in template strings.
_LEFT_OUT = {
    ".mjs": re.compile(
        r"^ *(?://.*|/\*\*(?:(?!\*/)[\s\S])*\*/)\n|/\*\* *@(?:(?!\*/).)*\*/ *| +// [^'\"`\n]*$|^ +|^\n", re.MULTILINE
    ),
    ".css": re.compile(r"^/\*.*\*/\n", re.MULTILINE),
    ".html": re.compile(r"^<!--.*-->\n", re.MULTILINE),
}
_STYLE = '<link rel="stylesheet" href="viewer.css">'
_SCRIPT = '<script type="module" src="main.mjs"></script>'
_POLICY = re.compile(r'(<meta http-equiv="Content-Security-Policy" content=")[^"]*(">)')
_START_WORKER = "new Worker(new URL('./worker.mjs', import.meta.url), { type: 'module' })"
# Runs in the page and, as the same text, in its worker.
_PROGRAM = """\
(function csplat() {
'use strict';
const modules = [
MODULES];
const made = [];
const link = (number) => (made[number] ??= modules[number](link));
let text = '';
link.startWorker = () => {
  if (!text) {
    const url = URL.createObjectURL(new Blob([`(${csplat})();`], { type: 'text/javascript' }));
    text = url;
    try {
      text = globalThis.trustedTypes?.createPolicy('csplat', { createScriptURL: () => url }).createScriptURL('') ?? url;
    } catch {}
  }
  return new Worker(text);
};
if (typeof document === 'undefined') link(WORKER);
else {
BEFORE  link(ENTRY);
}
})();
"""
_SCENE = """\
  globalThis.csplatEmbedded = {
    ...JSON.parse(document.getElementById('csplat-page').textContent),
    scene: () => {
      const element = document.getElementById('csplat-scene');
      const coded = element.textContent;
      element.remove();
      if (Uint8Array.fromBase64) return Uint8Array.fromBase64(coded).buffer;
      const bytes = new Uint8Array(Math.floor((coded.length * 3) / 4));
      const step = 1 << 16;
      let filled = 0;
      for (let at = 0; at < coded.length; at += step) {
        const text = atob(coded.slice(at, at + step));
        for (let i = 0; i < text.length; i++) bytes[filled++] = text.charCodeAt(i);
      }
      return bytes.buffer.slice(0, filled);
    },
  };
"""


@dataclass(frozen=True)
class ExportedPage:
    """An exported page.

    Attributes:
        page: the HTML file.
        code_bytes: its bytes without the scene.
        scene_bytes: bytes of the scene in it, as base64: 4/3 of its file.
    """

    page: bytes
    code_bytes: int
    scene_bytes: int


def export_page(scene: bytes, name: str, wishes: Mapping[str, str] | None = None) -> ExportedPage:
    """Put a scene, the viewer and the decoder into one page.

    Args:
        scene: the bytes of a .csplat file.
        name: name of the file, which the page shows.
        wishes: parameters of the page.

    Raises:
        InputError: the installation is incomplete.
    """
    texts = _texts()
    folder = posixpath.dirname(PAGE)
    script = f"\n{_program(texts, f'{folder}/main.mjs', _SCENE)}"
    style = f"\n{texts[f'{folder}/viewer.css']}"
    assert not re.search(r"</script|<!--", script, re.IGNORECASE), "the script fits into an element"
    assert style.isascii(), "a style cannot be escaped as the script is"
    coded = base64.b64encode(scene).decode()
    described = _json({"name": name, "wishes": dict(wishes or {})})
    body = (
        f'<script type="application/json" id="csplat-page">{described}</script>\n'
        f'<script type="application/octet-stream" id="csplat-scene">{coded}</script>\n'
        f"<script>{script}</script>\n"
    )
    page = texts[PAGE]
    page = _replace_once(page, _STYLE, f"<style>{style}</style>")
    page = _replace_once(page, _SCRIPT, "")
    page = _replace_once(page, "<title>csplat viewer</title>", f"<title>{html.escape(name)} – csplat viewer</title>")
    page = _replace_once(page, "</body>", f"{body}</body>")
    page, policy_count = _POLICY.subn(lambda match: match[1] + _policy(style, script) + match[2], page)
    assert policy_count == 1, "the page has one policy"
    data = page.encode("ascii", "xmlcharrefreplace")
    return ExportedPage(data, len(data) - len(coded), len(coded))


def export_element() -> bytes:
    """Return a script of viewer and decoder that defines the element `<csplat-view>`.

    Raises:
        InputError: the installation is incomplete.
    """
    return _program(_texts(), ELEMENT).encode()


def link_modules(texts: Mapping[str, str], entries: list[str]) -> dict[str, str]:
    """Turn the entry modules and their imports into functions.

    Args:
        texts: source texts of modules by their paths.
        entries: paths of the modules to begin with.

    Returns:
        Functions by path, each after the functions of its imports, with a trailing comma. A function is called with a
        function that returns the exports of another module by its number in this order. It returns its own exports.
        (Imports are not live bindings then; no module exports a value that changes.)
    """
    functions: dict[str, str] = {}
    numbers: dict[str, int] = {}
    open_paths: list[str] = []

    def visit(path: str) -> int:
        """Add a module after its imports, unless it was added before; return its number."""
        assert path not in open_paths, f"modules import each other: {' -> '.join([*open_paths, path])}"
        if path not in numbers:
            assert path in texts, f"{open_paths[-1] if open_paths else 'the page'} imports {path}, which does not exist"
            open_paths.append(path)
            text = _IMPORT.sub(lambda match: replace_import(path, match), texts[path])
            open_paths.pop()
            numbers[path] = len(functions)
            functions[path] = _as_function(path, text)
        return numbers[path]

    def replace_import(path: str, match: re.Match[str]) -> str:
        """Return a statement that takes the names of an import from a linked module, which is added first."""
        target = f"link({visit(posixpath.normpath(posixpath.join(posixpath.dirname(path), match['name'])))});"
        names = match["all"] or re.sub(r"\s+as\s+", ": ", match["some"] or "")
        return f"const {names} = {target}" if names else target

    for entry in entries:
        visit(entry)
    return functions


def _texts() -> dict[str, str]:
    """Return the text files of viewer and decoder by path, without comments and indentation, a third of modules."""
    return {path: _LEFT_OUT[file.suffix].sub("", file.read_text("utf-8")) for path, file in web_files().items()}


def _program(texts: Mapping[str, str], entry: str, before: str = "") -> str:
    """Return a classic script in ASCII that runs a module and its worker.

    Args:
        texts: source texts by their paths.
        entry: path of the module.
        before: statements to run before the module in the page.
    """
    modules = link_modules(texts, [entry, WORKER])
    order = list(modules)
    parts = {
        "MODULES": "".join(modules.values()),
        "WORKER": str(order.index(WORKER)),
        "BEFORE": before,
        "ENTRY": str(order.index(entry)),
    }
    script = re.sub("MODULES|WORKER|BEFORE|ENTRY", lambda match: parts[match[0]], _PROGRAM)
    script = script.encode("ascii", "backslashreplace").decode()  # JavaScript has the same \x… and \u… escapes
    assert "\\U000" not in script, "JavaScript has another escape for characters beyond U+FFFF"
    return script


def _as_function(path: str, text: str) -> str:
    """Return the text of a module whose imports are replaced as a function of `link` that returns its exports."""
    names = [match["name"] for match in _DECLARED.finditer(text)]
    names += [re.sub(r"([\w$]+)\s+as\s+([\w$]+)", r"\2: \1", match["names"]) for match in _LISTED.finditer(text)]
    text = _LISTED.sub("", _DECLARED.sub("", text))
    statement = _STATEMENT.search(text)
    assert statement is None, f"{path} has a statement that cannot be linked: {statement[0] if statement else ''}"
    text = text.replace(_START_WORKER, "link.startWorker()")
    text = text.replace("import.meta.url", "document.baseURI")  # the module is part of the page
    return f"// {path}\n(link) => {{\n{text}return {{ {', '.join(names)} }};\n}},\n"


def _json(value: object) -> str:
    """Return JSON that is safe in a script element."""
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def _policy(style: str, script: str) -> str:
    """Return a Content Security Policy that allows the content of the page and nothing from elsewhere."""
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (script, style)]
    return (
        f"default-src 'none'; script-src 'sha256-{hashes[0]}' 'wasm-unsafe-eval'; worker-src blob:;"
        f" style-src 'sha256-{hashes[1]}'; img-src data:; connect-src 'none'; base-uri 'none'; form-action 'none'"
    )


def _replace_once(text: str, old: str, new: str) -> str:
    """Return the text with `old`, which must be in it exactly once, replaced by `new`."""
    assert text.count(old) == 1, f"the page has {old!r} once"
    return text.replace(old, new)
