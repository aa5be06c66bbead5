# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures and hooks: helpers/shared_fixtures.py, and `browser`, `tab` and `site` of helpers/chromium.py."""

import signal

# A shell that runs the tests in the background lets all of its processes ignore Ctrl-C, which tests send.
signal.signal(signal.SIGINT, signal.default_int_handler)

pytest_plugins = ["shared_fixtures", "chromium"]
