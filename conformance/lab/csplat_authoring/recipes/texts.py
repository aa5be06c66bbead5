# SPDX-License-Identifier: CC0-1.0
"""JSON texts and declared errors: valid ones, and invalid ones that violate one rule each."""

from __future__ import annotations

import math
from functools import partial
from typing import Final

from csplat import _spec
from csplat_authoring.recipe import Recipe, invalid_recipe, valid_recipe
from csplat_authoring.samples import scene
from csplat_authoring.scene import Chunk, DeclaredErrors

_valid = partial(valid_recipe, "extreme")
_META, _CAMS, _OPTS = _spec.CHUNK_METADATA, _spec.CHUNK_CAMERAS, _spec.CHUNK_OPTIONS

#: Texts that JSN-1 refuses, by the name of the vector: the text and its defect.
_BAD: Final = {
    "word_short": (b'{"a":nul}', "null without its last letter"),
    "word_wrong": (b'{"a":nulx}', "null with another last letter"),
    "word_true": (b'{"a":trux}', "true with another last letter"),
    "word_false": (b'{"a":fals1}', "false with another last letter"),
    "word_capital": (b'{"a":True}', "a capital letter"),
    "word_longer": (b'{"a":nulll}', "null with a letter more"),
    "number_without_whole": (b'{"a":.5}', "a fraction without a digit before the point"),
    "number_without_fraction": (b'{"a":5.}', "a point without a digit after it"),
    "number_point_exponent": (b'{"a":5.e1}', "an exponent after a bare point"),
    "number_without_exponent": (b'{"a":5e}', "an exponent without digits"),
    "number_signed_exponent": (b'{"a":5e-}', "an exponent with a sign and no digits"),
    "number_plus": (b'{"a":+5}', "a plus before a number"),
    "number_minus": (b'{"a":-}', "a minus alone"),
    "number_minus_twice": (b'{"a":--5}', "two minus signs"),
    "number_minus_zero": (b'{"a":-05}', "a minus and a number that begins with 0"),
    "number_hexadecimal": (b'{"a":0x1}', "a hexadecimal number"),
    "number_tie": (b'{"a":[1.7976931348623158e308,1.797693134862315808e308]}', "just beyond what rounds to binary64"),
    "number_tie_negative": (b'{"a":-1.797693134862315808e+308}', "the same below 0"),
    "number_tie_integer": (b'{"a":1797693134862315808' + b"0" * 290 + b"}", "the same without a point"),
    "number_long_exponent": (
        b'{"a":0.' + b"0" * 10500 + b"1e10810}",
        "10^309, in digits and an exponent that partly cancel",
    ),
    "number_310": (b'{"a":1e310}', "10^310"),
    "number_huge_exponent": (b'{"a":1e99999999999999999999}', "an exponent beyond 64 bits"),
    "name_bare": (b"{a:1}", "a name without quotation marks"),
    "name_number": (b"{1:1}", "a number in the place of a name"),
    "name_unopened": (b'{a":1}', "a name without its first quotation mark"),
    "name_unclosed": (b'{"a\n:1}', "a line feed in the place of a name's last quotation mark"),
    "string_unclosed": (b'{"a":"b\n}', "a line feed in the place of a string's last quotation mark"),
    "name_missing": (b"{:1}", "no name"),
    "colon_missing": (b'{"a" 1}', "no colon"),
    "value_missing": (b'{"a":}', "no value"),
    "comma_missing": (b'{"a":1 "b":2}', "no comma between members"),
    "comma_first": (b'{,"a":1}', "a comma before the first member"),
    "comma_twice": (b'{"a":1,,"b":2}', "two commas"),
    "comma_array": (b'{"a":[1,]}', "a comma before the end of an array"),
    "comma_array_first": (b'{"a":[,1]}', "a comma before the first element"),
    "comma_array_missing": (b'{"a":[1 2]}', "no comma between elements"),
    "array_open": (b'{"a":[1', "an array without an end"),
    "array_closed_as_object": (b'{"a":[1}', "an array that ends like an object"),
    "object_closed_as_array": (b'{"a":1]', "an object that ends like an array"),
    "end_twice": (b'{"a":1}}', "a bracket too many"),
    "white_space_alone": (b" \n", "no value at all"),
    "white_space_feed": (b'{"a":\x0c1}', "a form feed between tokens"),
    "white_space_wide": (b'{"a":\xc2\xa01}', "U+00A0 between tokens"),
    "zero_after": (b"{}\0", "a byte of 0 after the value"),
    "comment": (b"{}//", "a comment"),
    "quote_single": (b"{'a':1}", "single quotation marks"),
    "string_open": (b'{"a":"b}', "a string without an end"),
    "string_escape_open": (b'{"a":"b\\', "a string that ends within an escape"),
    "escape_unknown": (b'{"a":"\\x41"}', "an escape that JSON does not have"),
    "escape_capital": (b'{"a":"\\U0041"}', "a capital in an escape"),
    "escape_short": (b'{"a":"\\u00e"}', "three digits in an escape"),
    "escape_digit": (b'{"a":"\\u00g0"}', "a digit that is not hexadecimal"),
    "escape_space": (b'{"a":"\\u 0e9"}', "a space among the digits of an escape"),
    "control_last": (b'{"a":"\x1f"}', "U+001F in a string"),
    "control_in_name": (b'{"\n":1}', "a line feed in a name"),
    "pair_reversed": (b'{"a":"\\ude00\\ud83d"}', "a surrogate pair, low half first"),
    "pair_high_twice": (b'{"a":"\\ud83d\\ud83d\\ude00"}', "two high halves before a low one"),
    "pair_low": (b'{"a":"\\udfff"}', "a low half alone"),
    "pair_beyond": (b'{"a":"\\ud83d\\ue000"}', "a high half, and a character behind the low ones"),
    "pair_low_first": (b'{"a":"\\udc00"}', "the first of the low halves alone"),
    "pair_high_last": (b'{"a":"\\ud83d\\udbff"}', "a high half, and the last of the high halves"),
    "pair_parted": (b'{"a":"\\ud83d \\ude00"}', "a space between the halves"),
    "pair_in_name": (b'{"\\udbff":1}', "a high half alone in a name"),
    "twice_by_pair": (b'{"\\ud83f\\udfff":1,"\xf0\x9f\xbf\xbf":2}', "a name twice, once as a pair of escapes"),
    "twice_by_two_pairs": (b'{"\\ud83d\\ude00":1,"\\uD83D\\uDE00":2}', "a name twice as pairs of escapes"),
    "twice_by_two_bytes": (b'{"\\u07ff":1,"\xdf\xbf":2}', "a name twice, once as an escape of U+07FF"),
    "twice_by_three_bytes": (b'{"\\u2fff":1,"\xe2\xbf\xbf":2}', "a name twice, once as an escape of U+2FFF"),
    "twice_empty": (b'{"":1,"":2}', "the empty name twice"),
    "twice_inside": (b'{"a":[[],{"b":1,"c":0,"b":1}]}', "a name twice in an object within an array"),
    "twice_prototype": (b'{"__proto__":1,"__proto__":1}', "a name that some languages treat apart, twice"),
    "utf_8_long": (b'{"a":"\xc0\xaf"}', "a character in more bytes than it needs"),
    "utf_8_long_last": (b'{"a":"\xc1\xbf"}', "U+007F in two bytes"),
    "utf_8_long_three": (b'{"a":"\xe0\x9f\xbf"}', "U+07FF in three bytes"),
    "utf_8_long_four": (b'{"a":"\xf0\x8f\xbf\xbf"}', "U+FFFF in four bytes"),
    "utf_8_five": (b'{"a":"\xf5\x80\x80\x80"}', "a byte that would begin U+140000"),
    "utf_8_alone": (b'{"a":"\x80"}', "a byte that continues nothing"),
    "utf_8_cut": (b'{"a":"\xe2\x82"}', "a character that is cut short"),
    "utf_8_beyond": (b'{"a":"\xf4\x90\x80\x80"}', "a character beyond U+10FFFF"),
    "utf_8_name": (b'{"\xff":1}', "a byte in a name that is not UTF-8"),
    "deep_objects": (b'{"a":' * 65 + b"1" + b"}" * 65, "65 objects, one in the other"),
    "top_string": (b'"a"', "a string in META"),
    "top_number": (b"1", "a number in META"),
    "top_null": (b"null", "null in META"),
}
_BAD_ELSEWHERE: Final = {
    "options_open": (_OPTS, b'{"a":1', "an object in OPTS without an end"),
    "cameras_null": (_CAMS, b"[null]", "null in CAMS"),
    "cameras_array": (_CAMS, b"[{},[]]", "an array in the array of CAMS"),
    "cameras_deep": (_CAMS, b"[{" + b'"a":' + b"[" * 63 + b"]" * 63 + b"}]", "65 levels in CAMS"),
}
_GOOD: Final = b"""\t\r\n { "numbers" : [ 0 , -0 , 9 , -9 , 19 , 90.9 , -0.99 , 9e9 , 9E+9 , 9.9e-9 , 0e99 , 0.0E-0 ,
1e09 , 5.09 , 1e-400 , 1.7976931348623158e308 , -1.797693134862315807e308 , 12345678901234567890 ] ,
"" : { "" : { "a":1 } , "a" : 2 } , "words" : [ true,false,null , [ ] , { } , "" ] , "\\u0061" : 1 , "A" : 2 ,
"__proto__" : 0 , "constructor" : 0 ,
"escapes" : "\\" \\\\ \\/ \\b \\f \\n \\r \\t \\u0123 \\u4567 \\u89AB \\uCDEF \\uabcd \\u0000 \\u001f",
"pairs" : "\\ud800\\udc00\\udbff\\udfff\\uD83D\\uDE00 \\ud7ff \\ue000 \\uffff", "siblings" : [[],[],[],{},{}] ,
"\\u07ff" : 0 , "\\u0800" : 0 , "\\u1800" : 0 , "\\u2800" : 0 ,
"ends" : "\xdf\xbf\xe0\xa0\x80\xed\x9f\xbf\xee\x80\x80\xf0\x90\x80\x80" ,
"not ASCII" : "\x7f\xc2\x80\xc3\xa9\xe2\x80\xa8\xef\xbb\xbf\xef\xbf\xbf\xf4\x8f\xbf\xbf" } \n\r\t"""


def good_text_recipes() -> list[Recipe]:
    """Return valid files whose texts use every production of JSON, and declared errors at their limits."""
    many = b'{"a":[' + b",".join(b"[" * 62 + b"]" * 62 for _ in range(3)) + b"]}"
    texts = (Chunk(_META, _GOOD), Chunk(_CAMS, b" [ ] "), Chunk(_OPTS, b"{}"))
    deep = (Chunk(_META, many), Chunk(_CAMS, b"[{},{}]"))
    slack = 1.0 + 2.0**-20
    # With an integer root the limit is exact; the others stay slightly below it.
    roots = {_spec.MEASURE_SH0: math.sqrt(3.0), _spec.MEASURE_SH1: 3.0 * slack}
    roots |= {_spec.MEASURE_SH0 + band: math.sqrt(6.0 * band + 3.0) for band in (2, 3, 4)}
    at_bounds = tuple((measure, 1.0, roots.get(measure, slack)) for measure in _spec.MEASURE_NAMES)
    zeros = tuple((measure, 0.0, 0.0) for measure in _spec.MEASURE_NAMES)
    pairs = ((-0.0, -0.0), (-0.0, 0.0), (0.0, -0.0))
    signs = tuple((measure, *pair) for measure, pair in zip(_spec.MEASURE_NAMES, pairs, strict=False))
    large = 2**64 - 1
    return [
        _good("json_grammar", "every production of JSON, numbers, escapes and characters at their limits", *texts),
        _good("json_deep_again", "the deepest nesting three times, one after the other", *deep),
        _declared("error_rms_at_bounds", "each rms as large as its max allows", DeclaredErrors(2, 0, 4, 0, at_bounds)),
        _declared("error_rms_zero", "an rms of 0 and a max of 0, of every measure", DeclaredErrors(2, 0, 3, 0, zeros)),
        _declared("error_minus_zero", "max and rms of −0, together and next to 0", DeclaredErrors(2, 0, 3, 0, signs)),
        _valid(
            "error_counts_of_none",
            "all splats of the source are gone",
            "SER-4",
            scene(tiles=[], chunks=(Chunk(_spec.CHUNK_DECLARED_ERRORS, errors=DeclaredErrors(5, 5)),)),
        ),
        _declared("error_counts_large", "2^64 − 1 splats in the source", DeclaredErrors(large, large - 2), "SER-4"),
    ]


def bad_text_recipes() -> list[Recipe]:
    """Return files with an invalid text or declared error."""
    result = [_bad(name, _META, text, why) for name, (text, why) in _BAD.items()]
    result += [_bad(name, kind, text, why) for name, (kind, text, why) in _BAD_ELSEWHERE.items()]
    slack = 1.0 + 2.0**-20
    beyond = {
        "means": math.nextafter(slack, 2.0),
        "covariance": math.nextafter(slack, 2.0),
        "opacities": math.nextafter(slack, 2.0),
        "sh0": 1.7321,
        "sh1": math.nextafter(3.0 * slack, 4.0),
        "sh2": 3.8731,
        "sh3": 4.5827,
        "sh4": 5.1962,
    }
    for name, rms in beyond.items():
        result.append(_bad_error(f"error_rms_of_{name}", f"an rms of {name} just beyond its bound", name, 1.0, rms))
    return [
        *result,
        _bad_error("error_rms_nan", "an rms that is no number", "means", 1.0, math.nan),
        _bad_error("error_rms_infinite", "an infinite rms with a large max", "sh3", 1e308, math.inf),
        _bad_error("error_rms_of_nothing", "an rms above a max of 0", "sh3", 0.0, 5e-324),
    ]


def _good(name: str, why: str, *chunks: Chunk) -> Recipe:
    return _valid(name, why, "JSN-1", scene(chunks=chunks))


def _declared(name: str, why: str, errors: DeclaredErrors, clause: str = "SER-2") -> Recipe:
    return _valid(name, why, clause, scene(chunks=(Chunk(_spec.CHUNK_DECLARED_ERRORS, errors=errors),)))


def _bad(name: str, kind: bytes, text: bytes, why: str) -> Recipe:
    made, at = scene(tiles=[], chunks=(Chunk(kind, text),)), f"{kind.decode()}/stream.width"
    return invalid_recipe(f"json_{name}", why, "JSN-1", "E_JSON", made, at=at)


def _bad_error(name: str, why: str, measure: str, largest: float, rms: float) -> Recipe:
    ids = {name: value for value, name in _spec.MEASURE_NAMES.items()}
    errors = DeclaredErrors(2, records=((ids[measure], largest, rms),))
    made = scene(chunks=(Chunk(_spec.CHUNK_DECLARED_ERRORS, errors=errors),))
    return invalid_recipe(name, why, "SER-2", "E_VALUE", made, at=f"SERR/record[{measure}].max")
