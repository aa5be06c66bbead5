"""Parts of an HTML report that opens from a disk and loads nothing else: style, script, their policy, tables."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Collection, Mapping, Sequence
from html import escape

_STYLE = """
:root {
  color-scheme: light dark;
  --text: #1d2126; --quiet: #59636e; --line: #d5dae0; --ground: #ffffff; --raised: #f5f7f9; --accent: #0b62a8;
  --front: #e3f1e9;
  font: 15px/1.5 system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif;
}
@media (prefers-color-scheme: dark) {
  :root {
    --text: #e4e8ed; --quiet: #9aa5b1; --line: #333b45; --ground: #14171b; --raised: #1c2127; --accent: #7cc0ff;
    --front: #1b3328;
  }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--text); }
main { max-width: 1320px; margin: 0 auto; padding: 28px 20px 60px; }
h1 { font-size: 26px; line-height: 1.2; margin: 0 0 6px; overflow-wrap: anywhere; }
h2 { font-size: 19px; margin: 40px 0 6px; }
h3 { font-size: 15px; margin: 22px 0 6px; }
p { margin: 0 0 12px; max-width: 76ch; }
.quiet, figcaption { color: var(--quiet); font-weight: 400; }
figure { margin: 0; min-width: 0; }
figcaption { font-size: 13px; max-width: 76ch; }
.scroll { overflow-x: auto; }
.plot svg { display: block; width: 100%; min-width: 600px; max-width: 820px; height: auto; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 600px), 1fr)); gap: 20px 28px; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 6px; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
.name { text-align: left; position: sticky; left: 0; background: var(--ground); }
.words { text-align: left; white-space: normal; min-width: 13em; }
thead th { color: var(--quiet); font-weight: 600; vertical-align: bottom; white-space: normal; }
thead button { all: unset; cursor: pointer; color: inherit; }
thead button:hover, thead button:focus-visible { color: var(--accent); text-decoration: underline; }
th[aria-sort='ascending'] button::after { content: ' \\25b2'; }
th[aria-sort='descending'] button::after { content: ' \\25bc'; }
tr.front td { background: var(--front); }
.copy {
  display: none; font: inherit; font-size: 12px; line-height: 1.4; padding: 0 7px; color: var(--accent);
  background: var(--raised); border: 1px solid var(--line); border-radius: 4px; cursor: pointer;
}
.live .copy { display: inline-block; }
.copy:hover, .copy:focus-visible { border-color: var(--accent); }
.legend { display: block; columns: 2 420px; column-gap: 36px; font-size: 13px; margin-top: 12px; }
.legend div { break-inside: avoid; padding-bottom: 4px; }
.legend dt, .legend dd { display: inline; }
.legend dt { font-weight: 600; color: var(--text); }
.commands div { padding: 6px 0; border-bottom: 1px solid var(--line); }
code { font: 12.5px/1.5 ui-monospace, 'SF Mono', Consolas, monospace; overflow-wrap: anywhere; }
.pictures { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(45%, 150px), 1fr)); gap: 6px; }
.pictures img { display: block; width: 100%; height: auto; background: #000; border-radius: 4px; }
dl { display: grid; grid-template-columns: fit-content(28ch) 1fr; gap: 3px 18px; margin: 0; }
@media (max-width: 640px) { dl { grid-template-columns: 1fr; } dd { padding-bottom: 6px; } }
dt { color: var(--quiet); }
dd { margin: 0; overflow-wrap: anywhere; }
summary { cursor: pointer; margin-top: 12px; }
"""

_SCRIPT = """
document.documentElement.classList.add('live');
for (const table of document.querySelectorAll('table.sortable')) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => head.querySelector('button')?.addEventListener('click', () => {
    const rising = head.getAttribute('aria-sort') !== 'ascending';
    const key = (row) => row.cells[column].dataset.value;
    const order = (a, b) => {
      const [x, y] = [key(a), key(b)];
      if (x === '' || y === '') return Number(x === '') - Number(y === '');
      const found = head.dataset.kind === 'text' ? x.localeCompare(y) : x - y;
      return rising ? found : -found;
    };
    for (const other of heads) other.removeAttribute('aria-sort');
    head.setAttribute('aria-sort', rising ? 'ascending' : 'descending');
    table.tBodies[0].append(...[...table.tBodies[0].rows].sort(order));
  }));
}
const copy = async (text) => {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const area = document.createElement('textarea');
    area.value = text;
    document.body.append(area);
    area.select();
    const done = document.execCommand('copy');
    area.remove();
    return done;
  }
};
for (const button of document.querySelectorAll('button.copy')) {
  const said = button.textContent;
  button.addEventListener('click', async () => {
    const code = document.getElementById(button.dataset.from);
    const done = await copy(code.textContent);
    if (!done) {
      code.closest('details')?.setAttribute('open', '');
      getSelection().selectAllChildren(code);
    }
    button.textContent = done ? 'copied' : 'press Ctrl+C';
    setTimeout(() => { button.textContent = said; }, 1500);
  });
}
"""


def document(title: str, parts: Sequence[str]) -> str:
    """Return a whole page from the parts of its body; empty ones are left out."""
    body = "\n".join(part for part in parts if part)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_policy()}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="referrer" content="no-referrer">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n<script>{_SCRIPT}</script>\n</body>\n</html>\n"
    )


def table(header: Sequence[str], rows: Sequence[Sequence[str]], words: Collection[int] = ()) -> str:
    """Return a table: names to the left, numbers to the right.

    Args:
        header: titles of the columns.
        rows: their cells.
        words: indices of columns that hold words, in addition to the first.
    """
    kinds = ["words" if place in words else "" if place else "name" for place in range(len(header))]
    marks = [f' class="{kind}"' if kind else "" for kind in kinds]
    heads = "".join(f'<th scope="col"{mark}>{escape(one)}</th>' for mark, one in zip(marks, header, strict=True))
    cells = "\n".join(
        "<tr>" + "".join(f"<td{mark}>{escape(cell)}</td>" for mark, cell in zip(marks, row, strict=True)) + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{heads}</tr></thead><tbody>\n{cells}\n</tbody></table></div>'


def definitions(entries: Mapping[str, str], kind: str = "") -> str:
    """Return a list of terms and their meanings; of kind `legend` it is laid out in columns."""
    mark = f' class="{kind}"' if kind else ""
    lines = [f"<dt>{escape(key)}</dt> <dd>{escape(value)}</dd>" for key, value in entries.items()]
    return f"<dl{mark}>\n" + "\n".join(f"<div>{line}</div>" if kind else line for line in lines) + "\n</dl>"


def copy_button(name: str, text: str) -> str:
    """Return a button that copies the text of the `command_line` of this name; it is shown only if scripts run."""
    return f'<button type="button" class="copy" data-from="{name}" title="{escape(text)}">copy</button>'


def command_line(name: str, text: str) -> str:
    """Return a command as an element that `copy_button` finds by its name."""
    return f'<code id="{name}">{escape(text)}</code>'


def _policy() -> str:
    """Return a Content Security Policy that allows this style, this script, embedded images, and no network."""
    return (
        f"default-src 'none'; script-src '{_hash(_SCRIPT)}'; style-src '{_hash(_STYLE)}'; img-src data:;"
        " connect-src 'none'; base-uri 'none'; form-action 'none'"
    )


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
