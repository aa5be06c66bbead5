"""The working folder: what is done of a file, so that an interrupted encoding can go on."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from csplat.encoder.tiling import BucketCurve, bucket_slices
from csplat.errors import InputError
from csplat.files import atomic_writer
from csplat.large.bucket_files import Layout, bucket_path, damaged, read_splats, write_splats
from csplat.large.coding import Bucket
from csplat.large.survey import Survey

_STATE = "state.json"
_SAMPLE = "sample"


@dataclass(eq=False)
class Work:
    """A working folder.

    Attributes:
        folder: path of the folder.
        layout: layout of the splats in it.
        state: progress so far: `key`, the scene and the options; `curve` and `largest` after the first pass;
            `counts`, splats of each bucket, after the second one; then `contrast`.
    """

    folder: Path
    layout: Layout
    state: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def begun(cls, folder: Path, layout: Layout, key: dict[str, Any], *, resume: bool) -> Work:
        """Make a folder, or go on in one.

        Raises:
            InputError: the folder is there and `resume` is not said, or is about another scene or other options, or
                holds something else.
            OSError: it cannot be made or read.
        """
        work = cls(folder, layout)
        if (folder / _STATE).exists():
            if not resume:
                raise InputError(
                    f"{folder} is left of an interrupted encoding: `--resume` goes on with it; or remove it"
                )
            try:
                work.state = json.loads((folder / _STATE).read_text())
            except ValueError:
                raise damaged(folder / _STATE) from None
            for name, value in key.items():
                if (found := work.state["key"].get(name)) != value:
                    raise InputError(f"{folder} was begun with another {name} ({found}, now {value}): remove it")
            return work
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder} holds something else: splats wait in a folder of their own, which is removed")
        folder.mkdir(exist_ok=True)
        work.note(key=key)
        return work

    def note(self, **done: Any) -> None:
        """Write down what is done.

        Raises:
            OSError: it cannot be written.
        """
        self.state.update(done)
        with atomic_writer(self.folder / _STATE) as stream:
            stream.write(json.dumps(self.state).encode())

    @property
    def survey(self) -> Survey | None:
        """Results of the first pass, `None` if it is not done.

        Raises:
            InputError: its file is damaged.
            OSError: it cannot be read.
        """
        if "curve" not in self.state:
            return None
        said = self.state["curve"]
        curve = BucketCurve(np.array(said["corner"]), said["scale"], np.array(said["bounds"], np.int64))
        return Survey(read_splats(self.folder / _SAMPLE, self.layout), self.state["largest"], curve)

    def keep(self, survey: Survey) -> None:
        """Write down the first pass.

        Raises:
            OSError: it cannot be written.
        """
        write_splats(self.folder / _SAMPLE, self.layout, survey.sample)
        curve = survey.curve
        said = {"corner": curve.corner.tolist(), "scale": curve.scale, "bounds": curve.bounds.tolist()}
        self.note(curve=said, largest=survey.largest)

    @property
    def buckets(self) -> list[Bucket]:
        """Buckets in the order of the file; known after the second pass."""
        parts = [
            (place, part) for place, count in enumerate(self.state["counts"]) if count for part in bucket_slices(count)
        ]
        return [Bucket(number, place, part.start, part.stop) for number, (place, part) in enumerate(parts)]

    def clear_buckets(self) -> None:
        """Remove what an interrupted second pass left."""
        for path in self.folder.glob("bucket-*"):
            path.unlink()

    def drop(self, bucket: Bucket, left: Sequence[Bucket]) -> None:
        """Remove the splats of a bucket that is coded, unless others that are not have the same file."""
        if all(other.place != bucket.place for other in left):
            bucket_path(self.folder, bucket.place).unlink(missing_ok=True)

    def remove(self) -> None:
        """Remove the folder: the file is written."""
        with suppress(OSError):
            shutil.rmtree(self.folder)
