# SPDX-License-Identifier: Apache-2.0
"""Search for the file of a scene that meets a target, over precision, coding of SH and number of splats."""
