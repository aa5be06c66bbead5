# SPDX-License-Identifier: Apache-2.0
"""Tests of csplat_conformance.validator.violation_log."""

import re

import pytest
from validator_cases import INVALID, SMALL, SPLATS_MAX

from csplat import _spec
from csplat_authoring.clauses import DOCUMENTS
from csplat_conformance.validator import validate
from csplat_conformance.validator.violation_log import CODES, VIOLATIONS_MAX

FORMAT, ENCODERS = (path.read_text(encoding="utf-8") for path in DOCUMENTS)

#: Clauses that no file can violate, with the reason.
UNBREAKABLE = {"AXI-1": "a stream of AXIS has three bytes at most (STR-2), which hold no more than 24 bits"}

#: Clauses of sections 2 to 8 that do not constrain the bytes of a file but decoders, readers of parts and editors, or
#: that are permissions; CBK-6 and CBK-7 only delimit other clauses.
NOT_ABOUT_FILES = {
    "NUM-1", "ORD-1", "ANC-1", "ANC-2", "ANC-3", "ANC-4", "HDR-12", "IDX-9", "DIR-3", "TIL-4", "COV-2", "CHK-2",
    "CHK-5", "CHK-6", "CHK-7", "CHK-8", "COD-4", "CBK-6", "CBK-7", "SER-6", "SER-7", "SRC-1", "SRC-2", "SRC-3", "SRC-4",
    "TRE-9", "LIM-2",
}  # fmt: skip


def test_every_clause_about_files_has_its_code():
    body = FORMAT.split("## 2 Conventions")[1].split("## 9 Conformance")[0] + ENCODERS.split("## 9.3 Encoders")[0]
    body = re.sub(r"```.*?```", "", body, flags=re.DOTALL)
    sentences = re.findall(r"([^\[\]]*(?:\[[^A-Z\]][^\]]*\][^\[\]]*)*)\[([A-Z]{3}-\d+)\]", body)
    texts = {clause: text for text, clause in sentences}
    assert set(texts) - NOT_ABOUT_FILES == set(CODES)
    wrong = [clause for clause, code in CODES.items() if code and code not in re.findall(r"E_[A-Z]+", texts[clause])]
    assert [] == wrong


@pytest.mark.long
def test_every_clause_is_reached_by_a_vector():
    found = [validate(vector.data, splats_max=SPLATS_MAX).violations for vector in INVALID]
    assert set(UNBREAKABLE) == set(CODES) - {one.clause for violations in found for one in violations}


@pytest.mark.long
def test_the_number_of_violations_is_bounded():
    data = bytearray(SMALL.data)
    header = _spec.unpack_header(data)
    record = _spec.pack_directory_record(_spec.DirectoryRecord(b"bad!", 0x00FC, 1, 1, 1, 1, 0, 0, 0))
    count = 5_500
    index = bytearray(data[_spec.HEADER_SIZE : _spec.HEADER_SIZE + header.index_size - 4])
    at = _spec.INDEX_HEAD_OFFSETS["directory_count"]
    index[at : at + 2] = count.to_bytes(2, "little")
    data[16:20] = (len(index) + count * len(record) + 4).to_bytes(4, "little")
    found = validate(bytes(data[: _spec.HEADER_SIZE]) + bytes(index) + record * count + bytes(4))
    assert VIOLATIONS_MAX == len(found.violations)
    assert "at least" in found.remarks[-1]
