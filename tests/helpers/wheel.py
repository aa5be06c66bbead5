# SPDX-License-Identifier: Apache-2.0
"""Unpack a wheel for tests: `python tests/helpers/wheel.py out/dist/csplat-1.0.0-py3-none-linux_x86_64.whl out/wheel`.

The folder then comes first on PYTHONPATH, so that tests see what users install, in the one environment that there is.
Modification times follow from contents, so that bytecode stays valid.
"""

import os
import sys
import zipfile
from pathlib import Path

PACKAGES = ("csplat", "csplat_render", "csplat_trainer", "csplat_tools", "csplat_conformance")
_EPOCH = 1_000_000_000  # seconds, 2001: modification times lie in the 136 years after it


def unpack(wheel: Path, folder: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        entries = {info.filename: info for info in archive.infolist() if not info.is_dir()}
        for path in [one for one in folder.rglob("*") if one.is_file() and one.suffix != ".pyc"]:
            if path.relative_to(folder).as_posix() not in entries:
                path.unlink()
        for name, info in entries.items():
            path = folder / name
            if not path.exists() or path.stat().st_mtime != _EPOCH + info.CRC or path.stat().st_size != info.file_size:
                archive.extract(info, folder)
                os.utime(path, (_EPOCH + info.CRC, _EPOCH + info.CRC))
    for package in PACKAGES:
        assert (folder / package / "__init__.py").exists(), f"{wheel} holds no package {package}"
    assert (folder / "csplat_program.py").exists(), f"{wheel} holds no entry point"
    assert wheel.stem.endswith("-any") == (not list(folder.glob("csplat_render/native/csplat_native_*")))


if __name__ == "__main__":
    unpack(Path(sys.argv[1]), Path(sys.argv[2]))
