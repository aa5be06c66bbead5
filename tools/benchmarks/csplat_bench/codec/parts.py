"""Measure how much of a file is read for a part of it, and how soon it is there: from the disk, by HTTP, from an S3.

    python -m csplat_bench.codec.parts scene.csplat
    python -m csplat_bench.codec.parts city.csplat --share 0.01 --runs 5 --markdown

The part is a cube in the middle of the scene, so wide that the tiles that touch it have that share of the splats, or
just more: tiles come whole. Servers are processes of this machine: the seconds are what csplat takes, your line comes
on top. Bytes and requests count from opening the file; header, index and the question for its size are in them. Medians
of runs, each of which opens the file anew, behind one that is not counted.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import csplat
from csplat.errors import missing_package
from csplat_bench.common.command import JSON, MARKDOWN, WrongWords, run
from csplat_bench.common.measuring import medians, timed
from csplat_bench.common.report import table, tell_machine, write_json
from csplat_tools.present.viewer_server import ViewerScene, open_server

_BUCKET = "scenes"
_KEYS = {"key": "nobody", "secret": "nothing"}


@dataclass(frozen=True)
class Row:
    """A part that was read from somewhere.

    Attributes:
        place: disk, HTTP or S3.
        sh_degree: highest band that was read.
        splats: number of splats in the part.
        requests, bytes_read: requests to the store, and bytes read from it, including opening.
        seconds: time of opening, reading and decoding together; time of opening alone.
    """

    place: str
    sh_degree: int
    splats: int
    requests: int
    bytes_read: int
    seconds: float
    open_seconds: float


def main(
    file: Annotated[Path, typer.Argument(metavar="FILE.csplat", help="what is measured")],
    *,
    share: Annotated[float, typer.Option(help="of the splats")] = 0.01,
    runs: Annotated[int, typer.Option(min=1, help="of each measurement")] = 3,
    markdown: MARKDOWN = False,
    json: JSON = None,
) -> None:
    """Read a part of a file from everywhere, and print a table."""
    if not 0.0 < share <= 1.0:
        raise WrongWords(f"--share is {share}, wanted above 0, 1 at most")
    machine = tell_machine()
    with csplat.open(file) as opened:
        header, size = opened.header, opened.size
        box = middle_box(opened, share)
    degrees = sorted({0, header.sh_degree})
    rows = []
    for place, (address, storage) in _places(file):
        rows += [measured(place, address, storage, box, degree, runs) for degree in degrees]
    print(f"{header.splat_count:,} splats in {len(header.tiles):,} tiles, {size:,} bytes, index {header.index_size:,}")
    columns = ("from", "SH", "splats", "% of splats", "requests", "bytes read", "% of file", "s", "of that opening, s")
    cells = [
        (
            one.place, one.sh_degree, f"{one.splats:,}", f"{100 * one.splats / header.splat_count:.2f}", one.requests,
            f"{one.bytes_read:,}", f"{100 * one.bytes_read / size:.2f}", f"{one.seconds:.3f}",
            f"{one.open_seconds:.3f}",
        )
        for one in rows
    ]  # fmt: skip
    print(table(columns, cells, markdown=markdown))
    if json is not None:
        write_json(json, {"machine": machine, "rows": [asdict(one) for one in rows]})


def middle_box(file: csplat.SplatFile, share: float) -> tuple[float, ...]:
    """The least cube about the middle of the tiles that enough splats are in: six numbers, scene units."""
    counts = np.array([tile.splat_count for tile in file.header.tiles])
    middles = file.boxes.mean(axis=1)
    centre = middles[np.argmin(np.linalg.norm(middles - np.median(middles, axis=0), axis=1))]
    # The half width of a cube that touches each tile, and the number of splats that it then holds.
    reach = np.maximum(0.0, np.maximum(file.boxes[:, 0] - centre, centre - file.boxes[:, 1])).max(axis=1)
    order = np.argsort(reach, kind="stable")
    enough = int(np.searchsorted(np.cumsum(counts[order]), share * counts.sum()))
    half = float(reach[order[min(enough, len(order) - 1)]])
    half += 4.0 * float(np.spacing(np.abs(centre).max() + half))  # sums round
    return (*(centre - half).tolist(), *(centre + half).tolist())


def measured(
    place: str, address: str, storage: Mapping[str, Any] | None, box: tuple[float, ...], degree: int, runs: int
) -> Row:
    """Read a box, several times."""

    def opened() -> csplat.SplatFile:
        return csplat.open(address, storage=storage)

    timings, openings, found = [], [], (0, 0, 0)
    for number in range(runs + 1):
        file, opening = timed(opened)
        with file:
            model, reading = timed(file.read, box, sh_degree=degree)
            found = (len(model), file.requests, file.bytes_read)
        if number:
            openings.append(opening)
            timings.append(type(reading)(opening.wall + reading.wall, opening.cpu + reading.cpu))
    return Row(place, degree, *found, medians(timings).wall, medians(openings).wall)


def _places(file: Path) -> Iterator[tuple[str, tuple[str, Mapping[str, Any] | None]]]:
    yield "disk", (str(file), None)
    with _process(_serve_web, str(file)) as address:
        yield "HTTP", (address, None)
    with _process(_serve_s3) as address:
        storage = {**_KEYS, "endpoint_url": address}
        _fill(file, storage)
        yield "S3", (f"s3://{_BUCKET}/{file.name}", storage)


@contextmanager
def _process(serve: Any, *words: str) -> Iterator[str]:
    """Run a server in a process of its own, which tells its address."""
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, *words), daemon=True)
    process.start()
    theirs.close()
    try:
        yield ours.recv()
    finally:
        process.terminate()
        process.join()


def _serve_web(told: Connection, path: str) -> None:
    file = Path(path).resolve()
    scene = ViewerScene(file.name, file, file.stat().st_size, csplat.read_header(file))
    with open_server(scene) as server:
        told.send(f"{server.url}scene/{file.name}")
        server.serve_forever()


def _serve_s3(told: Connection) -> None:
    import logging
    from threading import Event

    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    told.send(f"http://{host}:{port}")
    Event().wait()


def _fill(file: Path, storage: Mapping[str, Any]) -> None:
    """Put a file into the S3."""
    try:
        from s3fs import S3FileSystem
    except ModuleNotFoundError as error:
        raise missing_package(error, extra="remote") from None
    fs = S3FileSystem(**storage)
    fs.mkdir(_BUCKET)
    fs.put_file(str(file), f"{_BUCKET}/{file.name}")


if __name__ == "__main__":
    sys.exit(run(main))
