"""All mistakes, in the order of the encoder."""

from wrong_encoders import behaving, coding, file_bytes, preparing, quantising, reading, stating

GROUPS = {
    "reading": reading.MISTAKES,
    "preparing": preparing.MISTAKES,
    "quantising": quantising.MISTAKES,
    "coding": coding.MISTAKES,
    "file_bytes": file_bytes.MISTAKES,
    "stating": stating.MISTAKES,
    "behaving": behaving.MISTAKES,
}
MISTAKES = {name: mistake for group in GROUPS.values() for name, mistake in group.items()}
assert len(MISTAKES) == sum(map(len, GROUPS.values())), "two mistakes have one name"
