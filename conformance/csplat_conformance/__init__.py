# SPDX-License-Identifier: CC0-1.0
"""Conformance tests of the csplat format: vectors with their expected results, runners and a validator.

The vectors and the manifest are dedicated to the public domain (CC0 1.0). `csplat_authoring`, which is only in a
checkout, writes every byte of them and computes every expected number without the encoder and the decoders.
"""

#: Version of vectors, reference inputs and checks; it changes without the version of the format.
SUITE_VERSION = "1.0"
