"""One HTML file with a scene, the viewer and the decoder inside: it opens from a disk, without a network.

A page that was opened as `file:` may not import modules from neighbouring files, so that every module goes into
the page as text. A short script makes a blob: URL of each, those that others import first, and puts the URLs in the
places of the import specifiers; the worker does the same for itself. A policy in the page forbids it the network.
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

from csplat_tools.present.webroot import PAGE, WORKER, web_files

__all__ = ["Exported", "export_page", "module_graph"]

# The statements that import: `import … from '…'`, `import '…'`, `export … from '…'`, at the beginning of a line.
_IMPORT = re.compile(
    r"""^(?:import\s+(?:[\w$*{}\s,]+\sfrom\s+)?|export\s+(?:\*(?:\s+as\s+[\w$]+)?|\{[^}]*\})\s+from\s+)"""
    r"""(?P<quote>['"])(?P<name>\.{1,2}/[^'"\n]+)(?P=quote)""",
    re.MULTILINE,
)
_STYLE = '<link rel="stylesheet" href="viewer.css">'
_SCRIPT = '<script type="module" src="main.mjs"></script>'
_POLICY = re.compile(r'(<meta http-equiv="Content-Security-Policy" content=")[^"]*(">)')
# Makes the modules of a page or a worker: text and numbers of modules come in turn. Blobs made elsewhere would do for a
# page, but not for a worker of a file: page, whose origin is its own.
_MODULES = """\
const moduleUrls = (modules) => {
  const urls = [];
  for (const parts of modules) {
    const text = parts.map((part) => (typeof part === 'number' ? urls[part] : part)).join('');
    urls.push(URL.createObjectURL(new Blob([text], { type: 'text/javascript' })));
  }
  return urls;
};
"""
# A worker that is a module does not start from a file: page in every browser; a classic one that imports does. What
# is sent to it before its module is there waits.
_WORKER = """\
const early = [];
const keep = (event) => {
  event.stopImmediatePropagation();
  early.push(event);
};
addEventListener('message', keep);
import(moduleUrls(modules)[entry]).then(
  () => {
    removeEventListener('message', keep);
    for (const { data, ports } of early) dispatchEvent(new MessageEvent('message', { data, ports }));
  },
  (error) => setTimeout(() => { throw error; }),
);
"""
_BOOT = """\
const { modules, main, worker, name, wishes, texts } = JSON.parse(document.getElementById('csplat-page').textContent);
const urls = moduleUrls(modules.slice(0, main + 1));
globalThis.csplatEmbedded = {
  name,
  wishes,
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
  workerFactory: () => {
    const constants = `const modules = ${JSON.stringify(modules)}, entry = ${worker};\\n`;
    const blob = new Blob([constants, texts.modules, texts.worker], { type: 'text/javascript' });
    return new Worker(URL.createObjectURL(blob));
  },
};
import(urls[main]);
"""


@dataclass(frozen=True)
class Exported:
    """A page.

    Attributes:
        page: the file.
        code_bytes: what viewer and decoder take of it.
        scene_bytes: what the scene takes of it, coded as text; a third more than its file.
    """

    page: bytes
    code_bytes: int
    scene_bytes: int


def export_page(scene: bytes, name: str, wishes: Mapping[str, str] | None = None) -> Exported:
    """Put a scene and all that shows it into one page.

    Args:
        scene: a .csplat file.
        name: of the file, which the page shows.
        wishes: parameters of the page.

    Raises:
        InputError: the installation is not complete.
    """
    texts = {path: file.read_text("utf-8") for path, file in web_files().items()}
    folder = posixpath.dirname(PAGE)
    modules = module_graph(
        {path: text for path, text in texts.items() if path.endswith(".mjs")},
        [
            f"{folder}/main.mjs",
            WORKER,
        ],
    )
    order = list(modules)
    described = {
        "modules": list(modules.values()),
        "main": order.index(f"{folder}/main.mjs"),
        "worker": order.index(WORKER),
        "name": name,
        "wishes": dict(wishes or {}),
        "texts": {"modules": _MODULES, "worker": _WORKER},
    }
    boot = _MODULES + _BOOT
    style = f"\n{texts[f'{folder}/viewer.css']}"
    coded = base64.b64encode(scene).decode()
    body = (
        f'<script type="application/json" id="csplat-page">{_json(described)}</script>\n'
        f'<script type="application/octet-stream" id="csplat-scene">{coded}</script>\n'
        f"<script>{boot}</script>\n"
    )
    page = texts[PAGE]
    page = _replaced(page, _STYLE, f"<style>{style}</style>")
    page = _replaced(page, _SCRIPT, "")
    page = _replaced(page, "<title>csplat viewer</title>", f"<title>{html.escape(name)} – csplat viewer</title>")
    page = _replaced(page, "</body>", f"{body}</body>")
    page, found = _POLICY.subn(lambda match: match[1] + _policy(style, boot) + match[2], page)
    assert found == 1, "the page has one policy"
    data = page.encode()
    return Exported(data, len(data) - len(coded), len(coded))


def module_graph(texts: Mapping[str, str], entries: list[str]) -> dict[str, list[str | int]]:
    """Find the modules that entries import, and what they import in turn.

    Args:
        texts: source texts of modules by their paths.
        entries: paths of the modules to begin with.

    Returns:
        By path, each module behind those that it imports: its text cut at the import specifiers, which are numbers
        of modules in this order.
    """
    found: dict[str, list[str | int]] = {}
    numbers: dict[str, int] = {}
    open_paths: list[str] = []

    def visit(path: str) -> None:
        if path in found:
            return
        assert path not in open_paths, f"modules import each other: {' -> '.join([*open_paths, path])}"
        assert path in texts, f"{open_paths[-1] if open_paths else 'the page'} imports {path}, which is not there"
        open_paths.append(path)
        text, parts, at = texts[path], list[str | int](), 0
        for match in _IMPORT.finditer(text):
            target = posixpath.normpath(posixpath.join(posixpath.dirname(path), match["name"]))
            visit(target)
            parts += [text[at : match.start("name")], numbers[target]]
            at = match.end("name")
        parts.append(text[at:])
        open_paths.pop()
        numbers[path] = len(found)
        found[path] = parts

    for entry in entries:
        visit(entry)
    return found


def _json(value: object) -> str:
    """JSON that can stand in a script element: nothing in it looks like markup."""
    return json.dumps(value, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")


def _policy(style: str, script: str) -> str:
    """A Content Security Policy that allows what is inside the page and nothing from elsewhere."""
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (script, style)]
    return (
        f"default-src 'none'; script-src 'sha256-{hashes[0]}' blob:; worker-src blob:; style-src 'sha256-{hashes[1]}';"
        " img-src data:; connect-src 'none'; base-uri 'none'; form-action 'none'"
    )


def _replaced(text: str, old: str, new: str) -> str:
    assert text.count(old) == 1, f"the page has {old!r} once"
    return text.replace(old, new)
