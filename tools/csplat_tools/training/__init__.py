# SPDX-License-Identifier: Apache-2.0
"""Train scenes from images, and tune files by images or by renders of the source."""
