# SPDX-License-Identifier: Apache-2.0
"""Renders, videos, the viewer and its page."""
