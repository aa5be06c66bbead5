"""Style and script of the report's page, and the policy that allows these two and nothing else."""

from __future__ import annotations

import base64
import hashlib

__all__ = ["SCRIPT", "STYLE", "policy"]

STYLE = """
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
.quiet, figcaption { color: var(--quiet); }
figure { margin: 0; }
figcaption { font-size: 13px; max-width: 76ch; }
.plot svg { display: block; width: 100%; max-width: 820px; height: auto; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 440px), 1fr)); gap: 20px 28px; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: 4px 7px; text-align: right; white-space: nowrap; border-bottom: 1px solid var(--line); }
th:first-child, td:first-child { text-align: left; }
thead th { color: var(--quiet); font-weight: 600; vertical-align: bottom; }
thead button { all: unset; cursor: pointer; color: inherit; }
thead button:hover, thead button:focus-visible { color: var(--accent); text-decoration: underline; }
th[aria-sort='ascending'] button::after { content: ' \\25b2'; }
th[aria-sort='descending'] button::after { content: ' \\25bc'; }
tr.front td { background: var(--front); }
.pictures { display: grid; grid-template-columns: repeat(3, 1fr); gap: 6px; }
.pictures img { display: block; width: 100%; height: auto; background: #000; border-radius: 4px; }
@media (max-width: 640px) { .pictures { grid-template-columns: 1fr; } }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 2px 18px; margin: 0; }
dt { color: var(--quiet); }
dd { margin: 0; overflow-wrap: anywhere; }
"""

SCRIPT = """
for (const table of document.querySelectorAll('table.sortable')) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => head.querySelector('button').addEventListener('click', () => {
    const rising = head.getAttribute('aria-sort') !== 'ascending';
    const rows = [...table.tBodies[0].rows];
    const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent;
    const order = (a, b) => {
      const [x, y] = [Number(key(a)), Number(key(b))];
      const missing = Number(Number.isNaN(x)) - Number(Number.isNaN(y));
      if (column === 0) return (rising ? 1 : -1) * key(a).localeCompare(key(b));
      return missing || (rising ? x - y : y - x);
    };
    for (const other of heads) other.removeAttribute('aria-sort');
    head.setAttribute('aria-sort', rising ? 'ascending' : 'descending');
    table.tBodies[0].append(...rows.sort(order));
  }));
}
"""


def policy() -> str:
    """A Content Security Policy: this style, this script, pictures that are in the page, and no network."""
    return (
        f"default-src 'none'; script-src '{_hash(SCRIPT)}'; style-src '{_hash(STYLE)}'; img-src data:;"
        " connect-src 'none'; base-uri 'none'; form-action 'none'"
    )


def _hash(text: str) -> str:
    return f"sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}"
