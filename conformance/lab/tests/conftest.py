# SPDX-License-Identifier: CC0-1.0
"""Shared fixtures and hooks: helpers/shared_fixtures.py, and `browser`, `tab` and `site` of helpers/chromium.py."""

pytest_plugins = ["shared_fixtures", "chromium"]
