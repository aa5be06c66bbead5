# SPDX-License-Identifier: Apache-2.0
"""One function opens all images: by their first bytes, as one of five formats, with a budget, and silently."""

import io
import os
import re
import struct
import zlib

import numpy as np
import pytest
from tables import failures

from csplat.errors import InputError
from csplat.image_opener import open_image

Image = pytest.importorskip("PIL.Image", reason="requires the extra [render]")

RGB = (np.random.default_rng(0).random((16, 24, 3)) * 255).astype(np.uint8)


def saved(kind, **options):
    stream = io.BytesIO()
    Image.fromarray(RGB).save(stream, kind, **options)
    return stream.getvalue()


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width, height, *chunks):
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    rows = chunk(b"IDAT", zlib.compress(bytes(min((width + 1) * height, 1000))))  # no test decodes more
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(chunks) + rows + chunk(b"IEND", b"")


def spoilt(data, begin, end):
    return data[:begin] + bytes(255 - byte for byte in data[begin:end]) + data[end:]


def tiff(*entries, next_at=0):
    rows = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + rows + struct.pack("<I", next_at)


JPEG = saved("JPEG")
DEFLATED, LZW = (saved("TIFF", compression=kind) for kind in ("tiff_adobe_deflate", "tiff_lzw"))
LARGE_TEXT = zlib.compress(b"a" * (1 << 25))
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 32 32\n%%EndComments\nshowpage\n%%EOF\n"

#: Bytes of a file, and a part of the message; the name of the file never matters.
REFUSED = {
    "EPS": (EPS, "is PostScript (EPS), which is not read, expected PNG, JPEG, TIFF, WebP or BMP: convert it to PNG"),
    "EPS after a control character": (b"\x04" + EPS, "is PostScript (EPS)"),
    "EPS with a preview": (b"\xc5\xd0\xd3\xc6" + bytes(28) + EPS, "is PostScript (EPS)"),
    "PDF": (b"%PDF-1.4\n", "is a PDF"),
    "GIF": (saved("GIF"), "is a GIF"),
    "Netpbm": (saved("PPM"), "is a Netpbm file"),
    "ICO": (saved("ICO"), "is an icon (ICO)"),
    "TGA": (saved("TGA"), "is a TGA"),
    "DDS": (saved("DDS"), "is a DDS texture"),
    "FlashPix or MIC": (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600), "is an OLE file"),
    "Windows metafile": (b"\xd7\xcd\xc6\x9a\0\0" + bytes(60), "is a Windows metafile"),
    "Photoshop": (b"8BPS\0\1" + bytes(60), "is a Photoshop file (PSD)"),
    "JPEG 2000": (b"\0\0\0\x0cjP  \r\n\x87\n" + bytes(60), "is a JPEG 2000 file"),
    "HEIC": (b"\0\0\0\x18ftypheic" + bytes(60), "is a HEIC file"),
    "AVIF": (b"\0\0\0\x18ftypavif" + bytes(60), "is an AVIF file"),
    "SVG": (b'<?xml version="1.0"?>\n<!-- drawn -->\n<svg xmlns="http://www.w3.org/2000/svg">', "is an SVG"),
    "a video": (b"\0\0\0\x18ftypqt  " + bytes(60), "is a video"),
    "raw of Canon": (b"\0\0\0\x18ftypcrx " + bytes(60), "a camera's raw file, expected an image: develop it"),
    "raw of Fujifilm": (b"FUJIFILMCCD-RAW 0201", "a camera's raw file"),
    "DNG": (tiff((256, 8), (257, 8), (273, 8), (50706, 0x01040000)), "a camera's raw file"),
    "a preview in a raw": (tiff((254, 1), (256, 8), (257, 8), (273, 8)), "a camera's raw file"),
    "empty": (b"", "is empty"),
    "text": (b"not an image", "is not an image: it begins with b'not an i', expected PNG, JPEG, TIFF, WebP or BMP"),
    "a bomb": (png(13_300, 13_300), "has 13300×13300 pixels in 74 bytes, expected at most 67,108,864 pixels: scale"),
    "the largest PNG": (png(2**31 - 1, 2**31 - 1), "has 2147483647×2147483647 pixels"),
    "a bomb of a BMP": (spoilt(saved("BMP"), 20, 21), "pixels in"),
    "compressed text": (png(8, 8, chunk(b"zTXt", b"k\0\0" + LARGE_TEXT)), "has texts or a colour profile of too many"),
    "international text": (png(8, 8, chunk(b"iTXt", b"k\0\1\0\0\0" + LARGE_TEXT)), "bytes: save it without them"),
    "a colour profile": (png(8, 8, chunk(b"iCCP", b"k\0\0" + LARGE_TEXT)), "of too many bytes"),
    "a truncated PNG": (saved("PNG")[:300], "is a PNG that is truncated: copy or export it again"),
    "a truncated JPEG": (JPEG[:700], "is a JPEG that is truncated"),
    "a truncated WebP": (saved("WEBP")[:60], "is a WebP that is damaged"),
    "a truncated BMP": (saved("BMP")[:300], "is a BMP that is truncated"),
    "a damaged TIFF": (spoilt(DEFLATED, 200, 260), "is a TIFF that is damaged"),
    "another damaged TIFF": (spoilt(LZW, 200, 260), "is a TIFF that is damaged"),
    "a TIFF of large tags": (
        tiff(*((256 + i, 0x7FFFFFFF) for i in range(20))).replace(b"\1\0\0\0", b"\xff" * 4), "TIFF that is damaged"),
}  # fmt: skip

#: Files that are read although Pillow warns of them.
READ = {
    "a JPEG of a phone": JPEG[:2] + b"\xff\xe2\0\x28MPF\0II*\0\x08\0\0\0" + b"\xff" * 26 + JPEG[2:],
    "damaged EXIF": JPEG[:2] + b"\xff\xe1\0\x28Exif\0\0II*\0\x08\0\0\0" + b"\xff" * 24 + JPEG[2:],
    "an animation of no images": png(8, 8, chunk(b"acTL", bytes(8))),
    "a TIFF with a loop": tiff((256, 8), (257, 8), (273, 8), next_at=8),
}


def test_other_formats_and_bombs_are_refused_in_one_line(tmp_path, capfd):
    def check(case):
        data, message = case
        (tmp_path / "3.png").write_bytes(data)
        for source in (tmp_path / "3.png", data):
            with pytest.raises(InputError) as raised, open_image(source) as image:
                np.asarray(image.convert("RGB"))
            assert message in str(raised.value)
            assert not re.search("\n|object at 0x", str(raised.value))

    assert [] == failures(REFUSED, check)
    assert ("", "") == capfd.readouterr()


def test_doubtful_images_are_read_silently(capfd):
    for data in READ.values():
        with open_image(data) as image:
            image.convert("RGBA").load()
            _ = image.getexif()
    assert ("", "") == capfd.readouterr()


def test_the_first_bytes_determine_the_format(tmp_path):
    path = tmp_path / "a.eps"
    for kind in ("PNG", "JPEG", "TIFF", "WEBP", "BMP"):
        path.write_bytes(saved(kind))
        with open_image(path) as image:
            assert (24, 16, kind) == (*image.size, image.format)
    with pytest.raises(InputError, match=r"a\.eps is a BMP, expected WebP"), open_image(path, formats=("WebP",)):
        pass


def test_no_program_is_started(tmp_path, monkeypatch):
    (tmp_path / "gs").write_text(f"#!/bin/sh\necho ran >> {tmp_path / 'ran'}\n")
    (tmp_path / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    for name in ("3.png", "3.eps"):
        (tmp_path / name).write_bytes(EPS)
        with pytest.raises(InputError, match="PostScript"), open_image(tmp_path / name) as image:
            image.load()
    assert not (tmp_path / "ran").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes on Windows")
def test_pipes_devices_and_folders_are_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "3.png")
    (tmp_path / "4.png").mkdir()
    (tmp_path / "5.png").symlink_to("/dev/zero")
    for number, message in ((3, "not a regular file"), (4, "not a reg"), (5, "not a reg"), (6, "No such file")):
        with pytest.raises(InputError, match=rf"{number}\.png: {message}"), open_image(tmp_path / f"{number}.png"):
            pass


def test_large_images_of_large_files_are_within_the_budget():
    large, bomb = png(9_000, 9_000) + bytes(1_300_000), png(13_300, 13_300)
    with open_image(large) as image, open_image(bomb, budget=False) as larger:
        assert (9_000, 13_300) == (image.height, larger.height)
