# SPDX-License-Identifier: Apache-2.0
"""Run every command as a user without a home, with a read-only package and a full /tmp, and print a table.

For Linux, as root, by hand: `python tools/lab/other_user.py [COMMAND…]`. The commands run in a mount namespace of their
own, so nothing is left on the machine. A command passes if it ends with status 0, or with an error in one line; a
traceback, a raw message of a library or a file of an unexpected name fails.
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import csplat
from csplat.model import SplatModel, normalise_quats

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tests" / "helpers"))
import posed_sets  # noqa: E402

NOBODY = "65534"  # user without a home
SECONDS = 600  # wall time after which a command counts as hanging

#: By command: its arguments, in a folder with a scene, a file of it, and a data set.
COMMANDS = {
    "--version": "--version",
    "--help": "--help",
    "--show-completion": "--show-completion bash",
    "--install-completion": "--install-completion bash",
    "encode": "encode scene.ply encode.csplat",
    "encode a pipe": "encode - pipe.csplat",
    "encode a named pipe": "encode fifo named.csplat",
    "encode for a PSNR": "encode scene.ply target.csplat --target-psnr 25",
    "encode levels": "encode scene.ply levels.csplat --levels 1",
    "encode out of core": "encode scene.ply large.csplat --memory 512MB",
    "decode": "decode scene.csplat decode.ply",
    "finetune": "finetune scene.ply finetune.csplat --data set --iterations 3 --page finetune.html",
    "batch": "batch scenes batch --workers 2",
    "info": "info scene.csplat",
    "info --page": "info scene.csplat --page info.html",
    "verify": "verify scene.csplat --source scene.ply",
    "lint": "lint scene.ply",
    "compare with LPIPS": "compare scene.ply scene.csplat --lpips auto",
    "compare": "compare scene.ply scene.csplat --pictures pictures",
    "tradeoff": "tradeoff scene.ply --page tradeoff.html --what presets",
    "sensitivity": "sensitivity scene.ply scene.npz --data set",
    "convert": "convert scene.ply convert.sog",
    "convert streamed": "convert scene.ply streamed/lod-meta.json",
    "convert gltf": "convert scene.ply convert.glb",
    "convert spz": "convert scene.ply convert.spz",
    "simplify": "simplify scene.ply simplify.ply --keep 0.9",
    "extract": "extract scene.csplat extract.csplat --box -9,-9,-9,9,9,9",
    "extract a pipe": "extract scene.csplat - --box -9,-9,-9,9,9,9",
    "merge": "merge scene.csplat scene.csplat -o merge.csplat",
    "train": "train set train.ply --iterations 3 --max-splats 50 --page train.html",
    "train a file": "train set train.csplat --iterations 3 --max-splats 50 --checkpoint train.npz",
    "view": "view scene.ply --no-browser",
    "render": "render scene.ply images --orbit 2 --size 32x24",
    "render webp": "render scene.ply film.webp --orbit 2 --size 32x24",
    "render mp4": "render scene.ply film.mp4 --orbit 2 --size 32x24",
    "export-html": "export-html scene.ply page.html",
    "export-element": "export-element element.js",
    "conformance decoder": "conformance decoder --filter HDR-1",
    "conformance encoder": "conformance encoder --write-inputs inputs",
}

#: Prepares the namespace: the package and the folders of the system are read-only, /tmp is full, the folder is not.
_NAMESPACE = """
set -e
for path in "$ROOT" "$PREFIX" "$BASE"; do mount --bind "$path" "$path"; mount -o remount,ro,bind "$path"; done
mount --bind "$WORK" /mnt
mount -t tmpfs -o size=64k,mode=1777 none /tmp
dd if=/dev/zero of=/tmp/full bs=1k count=999 2>/dev/null || true
for path in /var/tmp /var/cache; do mount -t tmpfs -o ro none $path; done
cd /mnt
exec setpriv --reuid=$NOBODY --regid=$NOBODY --clear-groups \
    --inh-caps=+dac_read_search --ambient-caps=+dac_read_search \
    env -i PATH="$PREFIX/bin:/usr/bin:/bin" PYTHONUNBUFFERED=1 "$@"
"""

_RAW = re.compile(r"Traceback|Matplotlib|Fontconfig|[Ww]arning|mkdir -p|site-packages|Exception ignored")


def make_inputs(folder: Path) -> None:
    """Write a scene, a file of it, a named pipe and a data set into a folder that everybody may write."""
    rng = np.random.default_rng(0)
    count = 60
    model = SplatModel(
        means=rng.normal(size=(count, 3)).astype("<f4"),
        quats=normalise_quats(rng.normal(size=(count, 4)).astype("<f4")),
        scales=rng.normal(-2.0, 0.3, (count, 3)).astype("<f4"),
        opacities=rng.uniform(0.3, 0.9, count).astype("<f4"),
        sh0=rng.normal(size=(count, 3)).astype("<f4"),
        shN=np.zeros((count, 15, 3), "<f4"),
    )
    csplat.write_ply(str(folder / "scene.ply"), model)
    (folder / "scene.csplat").write_bytes(csplat.encode(model))
    (folder / "scenes").mkdir()
    for name in ("a.ply", "b.ply", "c.ply"):
        (folder / "scenes" / name).write_bytes((folder / "scene.ply").read_bytes())
    (folder / "set").mkdir()
    posed_sets.write_transforms(folder / "set")
    os.mkfifo(folder / "fifo")
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o777 if path.is_dir() else 0o666)


def run(folder: Path, words: list[str]) -> tuple[int, str]:
    """Run a command line in the folder as another user; return its status and standard error."""
    environment = {
        **os.environ, "ROOT": str(ROOT), "PREFIX": sys.prefix, "BASE": sys.base_prefix, "WORK": str(folder),
        "NOBODY": NOBODY,
    }  # fmt: skip
    program = ["timeout", "-s", "INT", "20" if words[0] == "view" else str(SECONDS), "csplat", *words]
    if "fifo" in words:
        program = ["sh", "-c", '(cat scene.ply > fifo &) ; exec "$@"', "sh", *program]
    with (folder / "scene.ply").open("rb") as scene, tempfile.TemporaryFile() as errors:
        words = ["unshare", "-m", "bash", "-c", _NAMESPACE, "bash", *program]
        status = subprocess.run(
            words, env=environment, stdin=scene, stdout=subprocess.DEVNULL, stderr=errors, check=False
        ).returncode
        errors.seek(0)
        return status, errors.read().decode(errors="replace")


def main() -> None:
    """Print a line for each command; exit with status 1 if one fails."""
    failed = False
    with tempfile.TemporaryDirectory(dir="/var/tmp") as name:  # not the /tmp that is hidden
        folder = Path(name)
        make_inputs(folder)
        for command in sys.argv[1:] or COMMANDS:
            status, errors = run(folder, COMMANDS[command].split())
            lines = errors.strip().splitlines()
            strange = sorted(
                path.name for path in folder.iterdir() if path.name.startswith(("~", ".", "tmp", "csplat-"))
            )
            is_good = not _RAW.search(errors) and not strange and (status in (0, 124) or "error:" in lines[-1])
            failed |= not is_good
            print(
                f"{command} | {status} | {'good' if is_good else 'BAD'} | {' / '.join(lines[-3:])} {strange or ''}",
                flush=True,
            )
    sys.exit(failed)


if __name__ == "__main__":
    main()
