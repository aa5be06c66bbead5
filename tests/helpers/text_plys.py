# SPDX-License-Identifier: Apache-2.0
"""Texts for the PLY readers in Python and C, which have one rule."""

import random
import struct
from decimal import Decimal, localcontext

COLUMNS = (
    *"xyz",
    *(f"rot_{i}" for i in range(4)),
    *(f"scale_{i}" for i in range(3)),
    "opacity",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
)
ROW = "1 2 3 1 0 0 0 -3 -3 -3 2 0.5 0.25 0.125"
HEADER_LINES = 4 + len(COLUMNS)

_PLAIN = (
    "0",
    "-0",
    "+3",
    "007",
    ".5",
    "5.",
    "-.5e1",
    "1.e5",
    "1E5",
    "1e+05",
    "1e400",
    "-1e-400",
    "inf",
    "-INF",
    "+Infinity",
)
_NANS = ("nan", "-NaN", "+nan", "nan()", "NAN(ind)", "1.#IND", "-1.#QNAN00", "1.#snan")
#: Numbers of float columns by their values; others are refused.
NUMBERS = {
    **{word: float(word) for word in _PLAIN},
    **dict.fromkeys(_NANS, float("nan")),
    "1.#INF": float("inf"),
    "-1.#inf0": float("-inf"),
    "1d5": 1e5,
    "-2.5D-1": -0.25,
    "1" * 400 + "e-400": float("1" * 400 + "e-400"),
    "0." + "0" * 900 + "1e901": 1.0,
}
NO_NUMBERS = (
    "1_0", "0x1p3", "0x10", "nan(12)", "nan(", "infin", "inf0", ".", "+", "e5", "1e", "1e+", "1e5.0", "1..2", "--1",
    "+-1", "1-2", "1f", "1j", "1.#INFX", "1#", "abc", "1\x1c2", "\0", "\xa01",
)  # fmt: skip
#: Integers of a uchar column; others are refused.
INTEGERS, NO_INTEGERS = ("0", "255", "+7", "-0", "007"), ("256", "-1", "1.0", "1e2", "0x1", "1_0", "9" * 40, "nan")

#: Bodies of two rows, with what is wrong; "": nothing.
LAYOUTS = {
    "lines": (f"{ROW}\n{ROW}\n", ""),
    "CR LF": (f"{ROW}\r\n{ROW}\r\n", ""),
    "CR, and no end of the last line": (f"{ROW}\r{ROW}", ""),
    "tabs and several spaces": (f" {ROW}\n{ROW} \n".replace(" ", " \t\x0b\x0c"), ""),
    "blank lines": (f"\n{ROW}\n \n\n{ROW}\n\n", ""),
    "all in one line": (f"{ROW} {ROW}\n", ""),
    "a word in each line": (f"{ROW} {ROW}".replace(" ", "\n"), ""),
    "rows on two lines": (f"{ROW}\n{ROW}\n".replace(" 1 0", "\n1 0"), ""),
    "commas": (f"{ROW}\n{ROW}\n".replace(" ", ", "), ""),
    "semicolons and decimal commas": (f"{ROW}\n{ROW}\n".replace(" ", ";").replace(".", ","), ""),
    "values after the rows": (f"{ROW}\n{ROW}\n1 2 3\n", ""),
    "a value missing": (f"{ROW}\n{ROW[2:]}\n", f"line {HEADER_LINES + 2}: row 1"),
    "a value missing after a blank line": (f"{ROW}\n\n{ROW[2:]}\n", f"line {HEADER_LINES + 3}: row 1"),
    "a value too many": (f"{ROW} 7\n{ROW}\n", f"line {HEADER_LINES + 1}: row 0"),
    "values that shift": (f"{ROW[2:]}\n{ROW} 7\n", f"line {HEADER_LINES + 1}: row 0"),
    "a row missing": (f"{ROW}\n", "present|cut off"),
    "values after rows in one line": (f"{ROW} {ROW}\n1\n", f"line {HEADER_LINES + 2}: "),
    "a word": (f"{ROW}\n{ROW.replace('0.25', 'x')}\n", f"line {HEADER_LINES + 2}: row 1"),
}
REFUSED = [name for name, (_, place) in LAYOUTS.items() if place]


def text_ply(body, count=2, *, extra="", comment=""):
    """Return a text; `extra` and `comment` are lines of the header, which count as lines of the file."""
    properties = "".join(f"property float {name}\n" for name in COLUMNS)
    head = f"ply\nformat ascii 1.0\n{comment}element vertex {count}\n{properties}{extra}end_header\n"
    return (head + body).encode("latin-1")


def hard_numbers(count, seed=0):
    """Return decimal numbers that are hard to round: halfway between two floats or doubles, and next to that."""
    rng, words = random.Random(seed), []  # noqa: S311 - numbers of tests, not keys
    with localcontext(prec=1100):
        while len(words) < count:
            form, size, bits = rng.choice([("<d", "<Q", 63), ("<f", "<I", 31)])
            number = rng.getrandbits(bits) >> rng.choice([0, 0, 0, 9, 12])  # the last are subnormal
            below, above = (struct.unpack(form, struct.pack(size, number + one))[0] for one in (0, 1))
            if not above < float("inf"):
                continue
            middle = (Decimal(below) + Decimal(above)) / 2
            mantissa, _, exponent = f"{middle:e}".partition("e")
            tail = "" if "." in mantissa else "."
            words += [
                repr(below), f"{middle:f}", f"{mantissa}{tail}{'0' * rng.randrange(900)}1e{exponent}",
                f"{middle * (1 - Decimal(10) ** -rng.randrange(20, 900)):e}",
            ]  # fmt: skip
    return words[:count]
