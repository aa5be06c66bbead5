# SPDX-License-Identifier: Apache-2.0
"""Edit scenes and files: merge, transform, change the up direction."""
