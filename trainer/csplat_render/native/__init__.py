# SPDX-License-Identifier: Apache-2.0
"""The compiled library of the renderer, and its sources: `build` compiles them."""
