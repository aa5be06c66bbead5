# SPDX-License-Identifier: Apache-2.0
"""Parts of a file: how much is read for them, and how soon they are there, from the disk, by HTTP, from an S3.

The part is a cube in the middle of the scene, so wide that the tiles that touch it hold the option `share` of the
splats, or slightly more: tiles come whole. Servers are processes of this machine, so that the seconds are csplat's own;
a network adds its own. Bytes and requests count from opening the file, with header, index and size.
A case has `place` (disk, HTTP or S3) and `sh_degree`; option `tile_splats`: size of the file's tiles.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

import csplat
from csplat.errors import missing_package
from csplat.splat_file import SplatFile
from csplat_bench.measuring import timed
from csplat_bench.protocol import AbsentError, Measure, Setup
from csplat_bench.scenes import find_scene
from csplat_bench.suites import Case
from csplat_tools.present.viewer_server import ViewerScene, open_server

_BUCKET = "scenes"
_KEYS = {"key": "nobody", "secret": "nothing"}

#: URL or path of a file, and the options of its store.
Address = tuple[str, Mapping[str, Any] | None]


@contextmanager
def measure_parts(setup: Setup, name: str, _: Sequence[Case]) -> Iterator[Measure]:
    """Yield the function that opens the file of a scene and reads the part."""
    scene, path = find_scene(name, setup.data, setup.work), setup.work / f"{Path(name).stem}.parts.csplat"
    options = csplat.EncodeOptions(preset="fast", tile_splats=setup.options.get("tile_splats", 4096))
    path.write_bytes(csplat.encode(csplat.read(scene.path), options))
    with SplatFile.open(path) as file:
        header, size = file.header, file.size_bytes
        box = middle_box(file, setup.options.get("share", 0.01))
    with ExitStack() as stack:
        addresses: dict[str, Address] = {}

        def measure(case: Case) -> Mapping[str, Any]:
            if case["place"] not in addresses:
                addresses[case["place"]] = stack.enter_context(_SERVERS[case["place"]](path))
            read = read_part(addresses[case["place"]], box, min(case["sh_degree"], header.sh_degree))
            return {"splats": header.splat_count, "tiles": len(header.tiles), "size_bytes": size, **read}

        yield measure


def middle_box(file: csplat.SplatFile, share: float) -> tuple[float, ...]:
    """Return the smallest cube about the middle tile whose tiles hold a share of the splats: six scene coordinates."""
    counts = np.array([tile.splat_count for tile in file.header.tiles])
    middles = file.boxes.mean(axis=1)
    centre = middles[np.argmin(np.linalg.norm(middles - np.median(middles, axis=0), axis=1))]
    # The half width of a cube that touches each tile, and the number of splats that it then holds.
    reach = np.maximum(0.0, np.maximum(file.boxes[:, 0] - centre, centre - file.boxes[:, 1])).max(axis=1)
    order = np.argsort(reach, kind="stable")
    enough = int(np.searchsorted(np.cumsum(counts[order]), share * counts.sum()))
    half = float(reach[order[min(enough, len(order) - 1)]])
    half += 4.0 * float(np.spacing(np.abs(centre).max() + half))  # sums are rounded
    return (*(centre - half).tolist(), *(centre + half).tolist())


def read_part(address: Address, box: tuple[float, ...], degree: int) -> dict[str, Any]:
    """Open a file and read a box; return splats, requests, bytes and seconds."""
    url, storage = address
    file, opening = timed(SplatFile.open, url, storage=storage)
    with file:
        model, reading = timed(file.read, box, sh_degree=degree)
        return {
            "read_splats": len(model), "requests": file.requests, "read_bytes": file.bytes_read,
            "seconds": opening.wall + reading.wall, "open_seconds": opening.wall,
        }  # fmt: skip


@contextmanager
def _on_disk(file: Path) -> Iterator[Address]:
    yield str(file), None


@contextmanager
def _by_http(file: Path) -> Iterator[Address]:
    with _process(_serve_web, str(file)) as address:
        yield address, None


@contextmanager
def _from_s3(file: Path) -> Iterator[Address]:
    try:
        from s3fs import S3FileSystem
    except ModuleNotFoundError as error:
        raise AbsentError(str(missing_package(error, extra="remote"))) from None
    with _process(_serve_s3) as address:
        storage = {**_KEYS, "endpoint_url": address}
        store = S3FileSystem(**storage)
        store.mkdir(_BUCKET)
        store.put_file(str(file), f"{_BUCKET}/{file.name}")
        yield f"s3://{_BUCKET}/{file.name}", storage


_SERVERS = {"disk": _on_disk, "HTTP": _by_http, "S3": _from_s3}


@contextmanager
def _process(serve: Any, *words: str) -> Iterator[str]:
    """Run a server in a process of its own; yield its address."""
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, *words), daemon=True)
    process.start()
    theirs.close()
    try:
        try:
            address = ours.recv()
        except EOFError:
            raise AbsentError(f"the {serve.__name__.removeprefix('_serve_')} server does not start") from None
        yield address
    finally:
        process.terminate()
        process.join()


def _serve_web(pipe: Connection, path: str) -> None:
    file = Path(path).resolve()
    scene = ViewerScene(file.name, file, file.stat().st_size, csplat.read_header(file))
    with open_server(scene) as server:
        pipe.send(f"{server.url}scene/{file.name}")
        server.serve_forever()


def _serve_s3(pipe: Connection) -> None:
    import logging
    from threading import Event

    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    pipe.send(f"http://{host}:{port}")
    Event().wait()
