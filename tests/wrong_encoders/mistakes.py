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
#: What the suite does not find, and why.
UNNOTICED = {
    "no input shows it": (
        "rest_cut_to_bands",
        "tiny_quats_identity",
        "huge_quats_identity",
        "infinite_scales_kept",
        "trailing_bytes_read",
        "doubles_as_single",
        "crlf_header",
        "face_element_first",
        "covariance_not_clipped",
    ),
    "errors may be of any size where they are honest": ("alpha_of_eight", "gauge_not_fixed"),
}
assert len(MISTAKES) == sum(map(len, GROUPS.values())), "two mistakes have one name"
