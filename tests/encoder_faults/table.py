"""All faults, in the order of the encoder."""

from encoder_faults import behaviour, coding, file_bytes, ply_reader, preparation, quantisation, statements

GROUPS = {
    "ply_reader": ply_reader.FAULTS,
    "preparation": preparation.FAULTS,
    "quantisation": quantisation.FAULTS,
    "coding": coding.FAULTS,
    "file_bytes": file_bytes.FAULTS,
    "statements": statements.FAULTS,
    "behaviour": behaviour.FAULTS,
}
FAULTS = {name: fault for group in GROUPS.values() for name, fault in group.items()}
assert len(FAULTS) == sum(map(len, GROUPS.values())), "two faults have one name"
