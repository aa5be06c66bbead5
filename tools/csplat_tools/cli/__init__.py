# SPDX-License-Identifier: Apache-2.0
"""The commands, one module each: they parse options, call a library function, and print."""
