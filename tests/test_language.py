"""The language of docstrings and comments: counts of banned openings and phrases, which only fall."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("codec", "trainer", "tools", "conformance", "tests", "spec")

#: What is counted in the Python files of the project, how, and how often it may be there at most. Lower a number when
#: it falls; never raise one.
CEILINGS = {
    "docstrings that open with What, Whether, Of, …": (
        r'^\s*r?"""(?:What|Who|Whom|Whose|Whether|Which|Where|Of|How|Why|When)\b',
        1,  # generated from a string in spec/generate.py
    ),
    "comments that begin with of, as of or those": (r"# (?:of|as of|those) ", 38),
    "so-manieth": (r"so-manieth", 0),
    "as of, for as in": (r"\bas of `", 19),
}


@pytest.fixture(scope="module")
def texts():
    """Return the text of each Python file of the project, by its path."""
    paths = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") if "node_modules" not in path.parts]
    return {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in paths}


@pytest.mark.parametrize("what", CEILINGS)
def test_there_is_no_more_of_what_is_banned(texts, what):
    pattern, ceiling = CEILINGS[what]
    expression = re.compile(pattern, re.MULTILINE)
    found = {path: len(expression.findall(text)) for path, text in texts.items() if path != "tests/test_language.py"}
    total = sum(found.values())
    most = sorted(((count, path) for path, count in found.items() if count), reverse=True)[:5]
    assert total <= ceiling, most
