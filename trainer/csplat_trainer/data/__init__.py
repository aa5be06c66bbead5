# SPDX-License-Identifier: Apache-2.0
"""Data sets of posed images, in common layouts on disk: `load(path)`."""

from csplat_trainer.data.dataset import DataSet
from csplat_trainer.data.loader import load

__all__ = ["DataSet", "load"]
