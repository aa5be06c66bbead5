"""Options that specify the views of a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import typer

from csplat.model import SplatModel
from csplat.upright import Direction
from csplat_render.virtual_cameras import estimate_up
from csplat_tools.cli.groups import Group, Output
from csplat_tools.cli.parsing import parse_axes, parse_colour, parse_size, parse_up, up_word
from csplat_tools.files.facts import SceneOverrides
from csplat_tools.views import VIRTUAL, DataOptions, Split, ViewSet, find_view_set

_DATA = "Photographs of --data (by default as the scene was trained)"
_VIEWS = "Views (virtual ones by default)"

SplitWord = Annotated[Split, typer.Option(metavar="test|train", rich_help_panel=_DATA, help="Which of them judge.")]
Near = Annotated[
    float | None, typer.Option(metavar="UNITS", rich_help_panel=_DATA, hidden=True, help="Their near plane.")
]


@dataclass(frozen=True)
class Upright(Group):
    """Options of the scene's orientation, which override what the scene declares."""

    up: Annotated[str | None, typer.Option(metavar="-y|X,Y,Z", help="Which way is up.")] = None
    axes: Annotated[
        str | None, typer.Option(metavar="RDF", hidden=True, help="Directions of +x, +y, +z: R/L, U/D, F/B.")
    ] = None

    def parse(self) -> None:
        """Refuse an invalid direction or axes."""
        self.upright()

    def upright(self) -> SceneOverrides:
        """Return the up direction and axes that the options specify, as overrides of the scene's own."""
        up = None if self.up is None else parse_up(self.up)
        return SceneOverrides(None if self.axes is None else parse_axes(self.axes), up=up)

    def seeming(self, axis: Direction | None, output: Output, *, shown: bool = True) -> Direction | None:
        """Return the estimated up direction, with a remark, if neither the user nor the scene specifies one.

        Args:
            axis: the estimate of `estimate_up`; `None`: there is none.
            output: prints remarks.
            shown: True if the command's result shows the scene with this direction up.
        """
        if axis is None or (self.up, self.axes) != (None, None):
            return None
        word = up_word(axis)
        output.remark(
            f"the scene does not say which way is up; {word} seems to be"
            + (", and is taken for it (encode --up writes it into a file)" if shown else f": --up {word} writes it")
        )
        return axis


@dataclass(frozen=True)
class Views(Group):
    """Views of a camera file or a data set."""

    one_of: ClassVar[Sequence[tuple[str, ...]]] = (("cameras", "data"),)
    needs: ClassVar[Mapping[str, tuple[str, ...]]] = dict.fromkeys(("size", "images", "test_every"), ("data",))

    cameras: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.json",
            rich_help_panel=_VIEWS,
            help="Cameras that judge; of 40 or more most teach and decide.",
        ),
    ] = None
    data: Annotated[
        str | None,
        typer.Option(
            metavar="DATA",
            rich_help_panel=_VIEWS,
            help="Photographs: training ones teach, held-out ones judge.",
        ),
    ] = None
    background: Annotated[
        str | None,
        typer.Option(
            metavar="R,G,B",
            rich_help_panel=_VIEWS,
            hidden=True,
            help="Behind the scene: black, but with --data or --cameras as in training.",
        ),
    ] = None
    size: Annotated[
        str | None, typer.Option(metavar="WxH", rich_help_panel=_DATA, hidden=True, help="Scale them to this size.")
    ] = None
    images: Annotated[
        str | None,
        typer.Option(metavar="NAME", rich_help_panel=_DATA, hidden=True, help="Folder of images, such as images_4."),
    ] = None
    test_every: Annotated[
        int | None,
        typer.Option(
            metavar="N", rich_help_panel=_DATA, hidden=True, help="Every Nth was held out; 8 if nothing says it."
        ),
    ] = None

    def parse(self) -> None:
        """Refuse an invalid colour or size."""
        _ = self.colour, None if self.size is None else parse_size(self.size)

    @property
    def inputs(self) -> tuple[str | None, str | None]:
        """Files that are read: the camera file and the data set."""
        return self.cameras, self.data

    @property
    def colour(self) -> tuple[float, float, float] | None:
        """Background colour, red, green, blue, 0 to 1; `None`: the default."""
        return None if self.background is None else parse_colour(self.background)

    def photographs(self, near: float | None = None) -> DataOptions | None:
        """Return the options of the data set; `None` without one.

        Args:
            near: near plane of the photographs; `None`: one that suits.
        """
        size = None if self.size is None else parse_size(self.size)
        return None if self.data is None else DataOptions(self.data, size, self.images, self.test_every, near)

    def find(
        self, model: SplatModel, output: Output, *, near: float | None = None, every: int = 1, **how: Any
    ) -> ViewSet:
        """Find views of a scene, and print remarks about them.

        Args:
            model: the scene.
            output: prints remarks.
            near: near plane of the photographs; `None`: one that suits.
            every: as for `find_view_set`.
            how: other arguments of `find_view_set`, passed on so that its defaults are defined in one place.
        """
        data = self.photographs(near)
        found = find_view_set(model, cameras=self.cameras, data=data, background=self.colour, every=every, **how)
        output.remark(*found.notes)
        axis = None if output.quiet or found.name != VIRTUAL else estimate_up(model, every)
        if axis is not None:
            word = up_word(axis)
            output.remark(
                f"views are placed as if the scene had -y up, which it does not say; {word} seems to be:"
                f" `csplat convert IN.ply OUT.ply --up {word}` says so, and other views have another PSNR"
            )
        return found


@dataclass(frozen=True)
class Virtual(Group):
    """Options of the virtual training views."""

    views: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=1, hidden=True, rich_help_panel=_VIEWS, help="Virtual views that teach, at most."
        ),
    ] = None
    view_size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH", hidden=True, rich_help_panel=_VIEWS, help="About how large pictures that teach are."
        ),
    ] = None

    def parse(self) -> None:
        """Refuse an invalid size."""
        self.given()

    def given(self) -> dict[str, Any]:
        """Return the options that are given, as arguments of `find_view_set`."""
        size = None if self.view_size is None else parse_size(self.view_size)
        return {name: value for name, value in (("count", self.views), ("size", size)) if value is not None}
