# SPDX-License-Identifier: Apache-2.0
"""Shared fixtures and hooks: helpers/shared_fixtures.py, and `browser`, `tab` and `site` of helpers/chromium.py."""

import os
import signal

# A shell that runs the tests in the background lets all of its processes ignore Ctrl-C, which tests send.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The terminal of whoever runs the tests is not what they test.
os.environ["COLUMNS"] = "80"
for name in ("FORCE_COLOR", "PY_COLORS", "CLICOLOR_FORCE", "GITHUB_ACTIONS"):
    os.environ.pop(name, None)

pytest_plugins = ["shared_fixtures", "chromium"]
