# SPDX-License-Identifier: Apache-2.0
"""Inspect a file: its content, its validity, its declared errors, and its differences from the source."""
