"""Build the command that makes a file of the sweep again, for readers to paste into a shell.

Targets, pruning and tuning depend on views, so that their commands name the views of the sweep.
"""

from __future__ import annotations

import json
import re
import shlex
from pathlib import PurePath
from typing import Any

from csplat_tools.file_streams import STANDARD_STREAM
from csplat_tools.study import Reduction
from csplat_tools.tradeoffs.sweep_options import SweepOptions, SweepSetting

_REDUCED = "from pathlib import Path; from csplat import EncodeOptions, read_ply; from csplat_tools.study import"


def file_name(setting: SweepSetting, name: str) -> str:
    """Return the file name of a point: `scene-target-40-dB.csplat`."""
    stem = "scene" if setting.path == STANDARD_STREAM else PurePath(setting.path).stem
    return f"{stem}-{re.sub(r'[^A-Za-z0-9.]+', '-', name)}.csplat"


def encode_command(setting: SweepSetting, name: str, preset: str, **options: Any) -> str:
    """Return the command for a file of `csplat encode` that needs no views.

    Args:
        setting: the scene.
        name: name of the point.
        preset: preset of the encoder.
        options: other options, such as `sh_degree`, and their values.
    """
    return _line("encode", setting, name, "--preset", preset, *_options(options))


def target_command(setting: SweepSetting, name: str, preset: str, **options: Any) -> str:
    """Return the command for a file of `csplat encode` that depends on views; see `encode_command`."""
    return _line("encode", setting, name, *_options(options), "--preset", preset, *_views(setting))


def finetune_command(setting: SweepSetting, name: str, sweep: SweepOptions, keep: float | None) -> str:
    """Return the command for a file of `csplat finetune`."""
    options = {"keep": keep, "iterations": None if sweep.iterations == SweepOptions.iterations else sweep.iterations}
    itself = () if setting.views.images else ("--self",)
    return _line("finetune", setting, name, *itself, *_options(options), "--preset", sweep.preset, *_views(setting))


def reduction_command(setting: SweepSetting, name: str, preset: str, reduction: Reduction) -> str:
    """Return a line of Python for a file of `csplat_tools.study`, which is a library without a command."""
    names, before, others, views = ["Reduction", "encode_reduced"], "", [], ""
    if reduction.prune_opacity is not None:
        others.append(f"prune_opacity={reduction.prune_opacity!r}")
    if reduction.sh_degree is not None:
        others.append(f"sh_degree={reduction.sh_degree}")
    if reduction.kmeans is not None:
        names.append("parse_kmeans")
        sizes = ",".join(f"{attribute}={size:g}" for attribute, size in reduction.kmeans.sizes.items())
        one = set(reduction.kmeans.sizes.values())
        others.append(f"kmeans=parse_kmeans({_text(f'{one.pop():g}' if len(one) == 1 else sizes)})")
    if reduction.distil:
        others.append("distil=True")
        before = "from csplat_tools.views import DataOptions, find_view_set; "
        views = f", views=find_view_set(scene{_arguments(setting)})"
    source = "/dev/stdin" if setting.path == STANDARD_STREAM else setting.path
    program = (
        f"{_REDUCED} {', '.join(names)}; {before}scene = read_ply({_text(source)}); "
        f"made = encode_reduced(scene, Reduction({', '.join(others)}), EncodeOptions(preset={_text(preset)}){views}); "
        f"Path({_text(file_name(setting, name))}).write_bytes(made.data)"
    )
    return f"python -c {shlex.quote(program)}"


def _line(command: str, setting: SweepSetting, name: str, *words: str) -> str:
    return shlex.join(["csplat", command, setting.path, file_name(setting, name), *words])


def _options(values: dict[str, Any]) -> list[str]:
    given = {name: value for name, value in values.items() if value is not None}
    return [word for name, value in given.items() for word in (f"--{name.replace('_', '-')}", _number(value))]


def _number(value: Any) -> str:
    """Return a number in its short form if that is exact, else in full."""
    short = str(value) if isinstance(value, int) else f"{value:g}"
    return short if float(short) == value else repr(value)


def _views(setting: SweepSetting) -> list[str]:
    """Return the options of `view_options.Views`."""
    words, data = list[str](), setting.data
    if setting.cameras is not None:
        words += ["--cameras", setting.cameras]
    if data is not None:
        words += ["--data", data.path]
        words += ["--size", f"{data.size[0]}x{data.size[1]}"] if data.size else []
        words += ["--images", data.images] if data.images else []
        words += ["--test-every", str(data.test_every)] if data.test_every else []
    if setting.background is not None:
        words += ["--background", ",".join(repr(one) for one in setting.background)]
    return words


def _arguments(setting: SweepSetting) -> str:
    """Return the views as arguments of `find_view_set`."""
    words, data = list[str](), setting.data
    if setting.cameras is not None:
        words.append(f"cameras={_text(setting.cameras)}")
    if data is not None:
        images = None if data.images is None else _text(data.images)
        words.append(f"data=DataOptions({_text(data.path)}, {data.size}, {images}, {data.test_every})")
    if setting.background is not None:
        words.append(f"background={setting.background}")
    return "".join(f", {word}" for word in words)


def _text(value: str) -> str:
    """Return a string literal of Python, in double quotation marks."""
    return json.dumps(value, ensure_ascii=False)
