"""Files that are read in parts, from a disk, from memory, from the web and from S3."""

import io
import math

import numpy as np
import pytest
from stores import Web, s3
from typer.testing import CliRunner

import csplat
from csplat import EncodeOptions, FormatError, InputError, LimitError, StoreError, _spec, decode, encode, read_header
from csplat import stores as module
from csplat.decoder import Limits, iter_tiles
from csplat_conformance.validator import validate
from csplat_tools.cli.app import app

ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def assert_same(a, b):
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.fixture(scope="module")
def data(sample_path):
    return encode(csplat.read_ply(sample_path), EncodeOptions(preset="fast", tile_splats=1000))


@pytest.fixture(scope="module")
def box(data):
    """That of the third tile, which others touch."""
    header = read_header(data)
    tile, step = header.tiles[2], header.attributes[3].step
    low = [corner * step * 2.0**tile.exponent for corner in tile.corner]
    return (*low, *(a + b * step * 2.0**tile.exponent for a, b in zip(low, tile.extent, strict=True)))


@pytest.fixture
def small_steps(monkeypatch):
    """Parts so small that a file of some hundred kB takes several requests."""
    monkeypatch.setattr("csplat.opened._FIRST", 512)
    monkeypatch.setattr("csplat.opened._BATCH", 60_000)
    monkeypatch.setattr("csplat.parts._BATCH", 20_000)
    monkeypatch.setattr("csplat.inputs._STEP_BYTES", 1)
    monkeypatch.setattr(module, "_GAP", 100)
    monkeypatch.setattr(module, "_REQUEST", 10_000)


@pytest.fixture
def web(data):
    server = Web({"/scene.csplat": data})
    with server.serve() as address:
        server.url = f"{address}/scene.csplat"
        yield server


# what is read


def test_a_part_is_that_of_a_whole_decode_and_less_is_read(data, box, tmp_path):
    (tmp_path / "scene.csplat").write_bytes(data)
    with csplat.open(tmp_path / "scene.csplat") as file:
        assert read_header(data) == file.header
        assert len(file) == file.splat_count == file.header.splat_count
        assert (1, 65536) == (file.requests, file.bytes_read)
        chosen = [tile.tile.index for tile in file.tiles(box)]
        assert 2 in chosen
        assert len(chosen) < len(file.header.tiles)
        assert_same(decode(data, tiles=chosen), file.read(box))
        assert_same(decode(data, tiles=chosen, sh_degree=1), file.read(box, sh_degree=1))
        assert_same(decode(data, tiles=[3, 1]), file.read(tiles=[3, 1]))
        assert decode(data).metadata == file.metadata
        assert decode(data).cameras == file.cameras
        assert_same(decode(data), file.read())


def test_boxes_are_those_of_the_splats(data):
    with csplat.open(data) as file:
        assert (len(file.header.tiles), 2, 3) == file.boxes.shape
        for box, tile in zip(file.boxes, file.tiles(sh_degree=0), strict=True):
            np.testing.assert_array_equal(box[0].astype(np.float32), tile.means.min(axis=0))
            np.testing.assert_array_equal(box[1].astype(np.float32), tile.means.max(axis=0))


@pytest.mark.usefixtures("small_steps")
def test_tiles_come_one_after_the_other_and_what_was_before_them_is_let_go_of(data, box):
    with csplat.open(io.BytesIO(data)) as file:
        for degree in (None, 0, 2):
            wanted = list(iter_tiles(data, sh_degree=degree))
            found = list(file.tiles(sh_degree=degree))
            assert len(wanted) == len(found)
            for a, b in zip(wanted, found, strict=True):
                assert_same(a, b)
        assert_same(decode(data, tiles=[tile.tile.index for tile in file.tiles(box)]), file.read(box))


@pytest.mark.usefixtures("small_steps")
def test_bands_that_are_not_wanted_are_not_fetched(data):
    layers = {layer: sum(tile.layers[layer].size for tile in read_header(data).tiles) for layer in range(4)}
    with csplat.open(data) as file:
        before = file.bytes_read
        file.read(sh_degree=0)
        assert layers[0] <= file.bytes_read - before < layers[0] + layers[1] / 2


@pytest.mark.usefixtures("small_steps")
def test_what_was_not_fetched_is_never_taken_for_data(data, monkeypatch):
    monkeypatch.setattr("csplat.opened._layers", lambda *_: [])
    with csplat.open(data) as file:
        with pytest.raises(FormatError, match="E_CRC"):
            file.read(tiles=[4])
        with pytest.raises(FormatError, match="E_CRC"):
            list(file.tiles())


def test_parts_that_lie_together_are_read_in_one_request(data):
    store = module.Memory(data)
    window = module.Window(store)
    gap = module._GAP
    window.fetch([(10, 5), (0, 10), (15 + gap, 5)])
    assert (1, 20 + gap) == (store.requests, store.bytes_read)
    window.fetch([(12, gap)])  # is there
    assert 1 == store.requests
    window.fetch([(100, 50 + gap)])  # the end of it is not
    assert (2, 150 + gap) == (store.requests, store.bytes_read)
    assert data[: 150 + gap] == window.view[: 150 + gap]
    assert not any(window.view[150 + gap :])
    window.forget()
    assert not any(window.view)


# what is refused


def test_arguments_that_make_no_sense_are_typed_errors_before_anything_is_read(data):
    with csplat.open(data, limits=Limits(splats=1000)) as file:
        before = file.bytes_read
        for call, error, says in (
            (lambda: file.read((0, 0, 0, 1, 1, math.nan)), InputError, "six finite numbers"),
            (lambda: file.read((1e6,) * 6), InputError, "no tile touches the box 1e.06"),
            (lambda: file.read(tiles=[99]), InputError, "tile 99"),
            (lambda: file.read(sh_degree=4), InputError, "sh_degree is 4"),
            (lambda: file.tiles(sh_degree=-1), InputError, "sh_degree is -1"),
            (lambda: file.read((0, 0, 0, 1, 1, 1), tiles=[1]), InputError, "wanted one of them"),
            (file.read, LimitError, "splats"),
        ):
            with pytest.raises(error, match=says):
                call()
        assert before == file.bytes_read
    with pytest.raises(InputError, match="is closed"):
        file.read()
    with pytest.raises(InputError, match="the file is none"):
        csplat.open(data, storage={"anon": True})


@pytest.mark.parametrize("size", [0, 10, 100, 3000, -1])
def test_a_file_that_is_cut_short_or_too_long_is_refused_as_a_decode_refuses_it(data, size):
    wrong = data + b"x" if size < 0 else data[:size]
    with pytest.raises(FormatError) as wanted:
        decode(wrong)
    with pytest.raises(FormatError) as found:
        csplat.open(wrong)
    assert str(wanted.value) == str(found.value)


def test_a_file_that_shrinks_or_changes_while_it_is_read_is_told(data, tmp_path):
    path = tmp_path / "scene.csplat"
    for wrong in (data[:70_000], data[:70_000] + bytes(len(data) - 70_000)):
        path.write_bytes(data)
        with csplat.open(path) as file:
            path.write_bytes(wrong)
            with pytest.raises(StoreError, match=r"scene\.csplat has changed while it was read"):
                file.read()


def test_a_damaged_file_is_named(data, tmp_path):
    wrong = bytearray(data)
    wrong[-1] ^= 1
    (tmp_path / "scene.csplat").write_bytes(wrong)
    with csplat.open(tmp_path / "scene.csplat") as file, pytest.raises(FormatError, match="E_CRC") as raised:
        file.read()
    assert str(tmp_path / "scene.csplat") == raised.value.path


# the web


def test_the_web_gives_the_parts_that_are_wanted(web, data, box):
    with csplat.open(web.url) as file:
        assert [("HEAD", None), ("GET", "bytes=0-65535")] == [(one[0], one[2]) for one in web.asked]
        chosen = [tile.tile.index for tile in file.tiles(box)]
        assert_same(decode(data, tiles=chosen), file.read(box))
        assert (len(web.asked), web.sent) == (file.requests, file.bytes_read)
        assert_same(decode(data), file.read())


@pytest.mark.usefixtures("small_steps")
def test_an_index_that_is_longer_than_the_first_request_takes_a_second_one(web, data):
    with csplat.open(web.url) as file:
        assert 2 <= len(web.gets)
        assert _spec.HEADER_SIZE + file.header.index_size == file.bytes_read
        assert read_header(data) == file.header


def test_a_server_without_parts_is_refused(web):
    web.ranges = False
    with csplat.open(web.url) as file, pytest.raises(StoreError, match=r"/scene\.csplat: the server sends whole files"):
        file.read(sh_degree=0)


def test_a_lost_connection_is_a_typed_error(web):
    web.cut_after = 0
    with pytest.raises(StoreError, match=r"/scene\.csplat: "):
        csplat.open(web.url)
    web.cut_after = 1 + len(web.gets)
    with csplat.open(web.url) as file:
        with pytest.raises(StoreError, match=r"/scene\.csplat: "):
            file.read(sh_degree=0)
        with pytest.raises(StoreError, match=r"/scene\.csplat: "):
            list(file.tiles())


@pytest.mark.parametrize("size", [None, 70_000])
def test_a_file_that_changes_between_requests_is_told(web, data, size):
    with csplat.open(web.url) as file:
        web.files["/scene.csplat"] = bytes(reversed(data))[:size]
        with pytest.raises(StoreError, match=r"/scene\.csplat has changed while it was read: open it again"):
            file.read(tiles=[5])


def test_a_file_of_the_web_that_is_damaged_is_named(web, data):
    web.files["/scene.csplat"] = data[:-1] + bytes([data[-1] ^ 1])
    with csplat.open(web.url) as file, pytest.raises(FormatError, match="E_CRC") as raised:
        file.read()
    assert web.url == raised.value.path


@pytest.mark.parametrize(
    ("answer", "error", "says"),
    [(404, FileNotFoundError, "No such file"), (403, PermissionError, "Permission"), (500, StoreError, "status 500")],
)
def test_what_a_server_refuses_is_said_without_secrets(web, answer, error, says):
    web.files["/other.csplat?key=secret"] = answer
    address = web.url.replace("://", "://somebody:password@").replace("scene", "other")
    with pytest.raises(error, match=says) as raised:
        csplat.open(address + "?key=secret")
    assert "other.csplat" in str(raised.value)
    assert "secret" not in str(raised.value)
    assert "password" not in str(raised.value)


def test_a_url_that_nothing_knows_is_refused():
    with pytest.raises(InputError, match="nowhere://scene"):
        csplat.open("nowhere://scene.csplat")


def test_without_the_extra_a_url_says_what_is_missing(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "fsspec.core", None)
    with pytest.raises(InputError, match=r"pip install 'csplat\[remote\]'"):
        csplat.open("https://example.org/scene.csplat")


def test_other_file_systems_of_fsspec_serve_too(data, box, tmp_path):
    import fsspec

    (tmp_path / "scene.csplat").write_bytes(data)
    fsspec.filesystem("memory").pipe("/scene.csplat", data)
    for url in ("memory://scene.csplat", f"file://{tmp_path}/scene.csplat"):
        with csplat.open(url) as file:
            assert_same(decode(data, tiles=[tile.tile.index for tile in file.tiles(box)]), file.read(box))


# S3


def test_s3_gives_the_parts_that_are_wanted(data, box):
    with s3({"scene.csplat": data}) as storage:
        with csplat.open("s3://scenes/scene.csplat", storage=storage) as file:
            assert 65536 == file.bytes_read
            assert_same(decode(data, tiles=[tile.tile.index for tile in file.tiles(box)]), file.read(box))
            stream = io.BytesIO()
            part = file.extract(box, stream)
            file._store._fs.pipe("scenes/scene.csplat", bytes(reversed(data)))
            with pytest.raises(StoreError, match="has changed while it was read"):
                file.read(tiles=[5])
            file._store._fs.rm("scenes/scene.csplat")
            with pytest.raises(FileNotFoundError, match=r"s3://scenes/scene\.csplat"):
                file.read(tiles=[5])
        assert part.splat_count == len(decode(stream.getvalue()))
        with pytest.raises(FileNotFoundError, match="s3://scenes/absent"):
            csplat.open("s3://scenes/absent", storage=storage)


# the command


def test_extract_takes_a_url_and_says_what_it_read(web, data, box, tmp_path):
    out = tmp_path / "part.csplat"
    words = ["extract", web.url, str(out), f"--box={','.join(map(repr, box))}"]
    done = CliRunner().invoke(app, words)
    assert 0 == done.exit_code, done.stderr
    assert "; read " in done.stderr
    local = tmp_path / "local.csplat"
    csplat.extract(data, box, local)
    assert local.read_bytes() == out.read_bytes()
    assert () == validate(out.read_bytes()).violations
    web.cut_after = 0
    refused = CliRunner().invoke(app, [*words, "--force"])
    assert 1 == refused.exit_code
    assert 1 == len(refused.stderr.splitlines())
    assert web.url in refused.stderr
    assert local.read_bytes() == out.read_bytes()  # the one that was there
    web.cut_after = 1 + len(web.gets)
    refused = CliRunner().invoke(app, ["extract", web.url, "-", *words[3:]])
    assert (1, b"") == (refused.exit_code, refused.stdout_bytes)


def test_extract_reads_standard_input_and_writes_standard_output(data, box):
    words = ["extract", "-", "-", f"--box={','.join(map(repr, box))}"]
    done = CliRunner().invoke(app, words, input=data)
    stream = io.BytesIO()
    csplat.extract(data, box, stream)
    assert (0, stream.getvalue()) == (done.exit_code, done.stdout_bytes)
    refused = CliRunner().invoke(app, words, input=data[:-1])
    assert 1 == refused.exit_code
    assert refused.stderr.startswith("error: standard input: the file ends too early")
    refused = CliRunner().invoke(app, words, input=b"ply\nformat")
    assert "standard input is a PLY" in refused.stderr
