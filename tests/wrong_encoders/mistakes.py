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
    "errors may be of any size where they are honest": (
        "pruned_most",
        "bands_dropped",
        "all_bands_dropped",
        "alpha_of_eight",
        "gauge_not_fixed",
        "means_truncated",
        "scales_truncated",
        "quats_truncated",
        "opacities_truncated",
        "sh0_truncated",
        "sh_truncated",
        "all_truncated",
    ),
    "runs are not compared": (
        "order_by_chance",
        "temporary_name_kept",
        "seed_by_chance",
        "time_in_options",
        "sums_in_any_order",
    ),
    "the user's files are not looked at": (
        "input_resaved",
        "input_appended",
        "input_moved_away",
        "temporary_left",
        "log_left",
        "written_twice",
    ),
    "all of nasty/ may be refused": ("refuses_the_unusual",),
    "the encoder's own map is not asked for": (
        "index_of_the_file",
        "index_inverse",
        "index_from_one",
        "index_in_floats",
        "index_too_short",
    ),
}
assert len(MISTAKES) == sum(map(len, GROUPS.values())), "two mistakes have one name"
