"""Data sets of posed pictures, in the layouts that people have on disk: `load(path)`."""

from csplat_trainer.data.dataset import DataSet
from csplat_trainer.data.loading import load

__all__ = ["DataSet", "load"]
