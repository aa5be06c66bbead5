"""Helpers of the tests of conformance runner, which several files share."""

from csplat_conformance.manifest import load

VECTOR_LIST = load()


# Recorded answers of our decoder by the protocol, with a selectable fault; no slow imports.
FAULTY = """
import json, os, pathlib, shutil, signal, struct, sys, time

fault, source, outdir = sys.argv[1], sys.argv[2], pathlib.Path(sys.argv[3])
instead = {
    "crash": lambda: os.kill(os.getpid(), signal.SIGSEGV),
    "hang": lambda: time.sleep(60),
    "status": lambda: sys.exit(77),
    "traceback": lambda: {}["tile"],
    "silent": lambda: sys.exit(0),
    "believes json_open": lambda: "json_open." in source and sys.exit(0),
    "no code": lambda: print("it is broken") or sys.exit(1),
    "refusal": lambda: print('{"code": "E_MAGIC"}') or sys.exit(1),
}
instead.get(fault, int)()
recorded = pathlib.Path(__file__).parent / "recorded" / pathlib.Path(source).stem
status, words = json.loads(recorded.with_suffix(".json").read_text())
sys.stdout.write(words)
for path in recorded.iterdir():
    shutil.copy(path, outdir)
header, means = outdir / "header.json", outdir / "floats.means.bin"
raw = means.read_bytes() if means.exists() else b""
bits = [value for (value,) in struct.iter_unpack("<I", raw)]
change = {
    "leftovers": lambda: means.write_bytes(b"part"),
    "no header": header.unlink,
    "header": lambda: header.write_text("[]"),
    "fact": lambda: header.write_text(json.dumps(json.loads(header.read_text()) | {"splat_count": 3})),
    "missing": (outdir / "integers.means.bin").unlink,
    "extra": (outdir / "floats.colours.bin").touch,
    "unknown file": (outdir / "log.txt").touch,
    "partial": lambda: means.write_bytes(raw[:-1]),
    "longer": lambda: means.write_bytes(raw + b"0"),
    "rounding": lambda: means.write_bytes(bytes([raw[0] ^ 1]) + raw[1:]),
    "2 ulp": lambda: means.write_bytes(struct.pack(f"<{len(bits)}I", *(value + 2 for value in bits))),
    "3 ulp": lambda: means.write_bytes(struct.pack(f"<{len(bits)}I", *(value + 3 for value in bits))),
}
change.get(fault, int)()
sys.exit(status)
"""


FAULTY_CUTS = """
import json, pathlib, sys

fault, source, cuts = sys.argv[1:]
known = json.loads((pathlib.Path(__file__).parent / "cuts.json").read_text())[pathlib.Path(source).stem]
given = [known[cut] for cut in pathlib.Path(cuts).read_text().splitlines()]
lines = [tiles if isinstance(tiles, str) else " ".join(map(str, tiles)) for tiles in given]
if fault == "status":
    sys.exit(77)
if fault == "refusal":
    print(json.dumps({"code": "E_INDEX", "clause": "TRE-5"}))
    sys.exit(1)
unsupported = {
    "no sizes": lambda cut: "pixel_size" in cut,
    "no list of sizes": lambda cut: len(cut.split(" box ")[0].split()) > 2,
    "no boxes": lambda cut: " box " in cut,
    "no cuts": lambda cut: True,
}.get(fault, lambda cut: False)
lines = ["E_UNSUPPORTED" if unsupported(cut) else line for cut, line in zip(known, lines)]
changed = {
    "silent": [],
    "short": lines[:-1],
    "long": [*lines, "0"],
    "words": [lines[0], "tile 2", *lines[2:]],
    "one wrong": [lines[0], "1 0", *lines[2:]],
    "empty cuts": [""] * len(lines),
    "no error code": ["E_INPUT" if line == "E_LIMIT" else line for line in lines],
}
for line in changed.get(fault, lines):
    print(line)
"""


#: Vectors whose answers are recorded.
RECORDED = (
    "valid/quats", "invalid/quat_radicand", "invalid/json_open", "invalid/json_surrogate",
    "invalid/json_beyond_budget", "invalid/error_counts",
)  # fmt: skip
