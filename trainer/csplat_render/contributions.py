"""Contribution of each splat to the renders of a scene: sums over pixels per splat, without building any matrix.

A `DrawnView` is one view of fixed splats, projected and sorted into tiles, with nothing kept but the splats that it
shows. It answers two questions: what the removal of each splat would change, and what renders follow from other
colours, with the way back from pixels to colours.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from csplat.model import sh_degree_of
from csplat_render.arrays import Array, HasSplats, Splats
from csplat_render.binning import TILE
from csplat_render.blending import blend, blend_counted
from csplat_render.blending_colours import COLOUR_SUMS, sum_colours
from csplat_render.blending_sums import SUMS, sum_removal
from csplat_render.camera import Camera
from csplat_render.conventions import TRANSMITTANCE_MIN, view_vector
from csplat_render.drawn_view import DrawnView, add_gradient, add_removal, basis_of_view, set_colours
from csplat_render.jit import thread_count
from csplat_render.projecting import BLOCK, project
from csplat_render.rasterise import Rasteriser

# Colours are taken for no brighter: squares of their differences, summed over a tile, stay within float32.
_BRIGHTEST = 1e15

# Allowance for rounding of an exponent: far from a splat's centre it is a small difference of large numbers, up to 1e4.
_MARGIN = 0.05


class Contributions(Rasteriser):
    """Draws views and sums over their pixels; arguments as those of `Rasteriser`, and when a pixel is finished.

    No result depends on the number of threads: every splat of every tile has a record of its own, and a splat's
    records are added up in one order.
    """

    def __init__(
        self,
        dtype: Any = np.float32,
        *,
        transmittance_min: float = TRANSMITTANCE_MIN,
        threads: int | None = None,
    ) -> None:
        super().__init__("standard", dtype, gradients=True, threads=threads)
        self._limits[2] = transmittance_min

    def draw(self, splats: HasSplats, camera: Camera, *, antialiased: bool = False, basis: bool = True) -> DrawnView:
        """Project splats, sort them into the tiles of a picture, and forget what it does not show.

        Args:
            splats: the scene.
            camera: the view.
            antialiased: scale opacities by what the dilation added.
            basis: True if the view needs spherical harmonics by splat.

        Raises:
            LimitError: there are too many pairs of splat and tile.
        """
        arrays = Splats(
            *(
                np.ascontiguousarray(getattr(splats, name), self.dtype)
                for name in ("means", "quats", "scales", "opacities", "sh0", "shN")
            )
        )
        n, degree = len(arrays.means), sh_degree_of(arrays.shN.shape[1])
        width, height = camera.W, camera.H
        tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
        shape, extent = self._buffer("shape", (n, 10), np.float64), self._buffer("extent", (n, 6), np.float64)
        box, near = self._buffer("box", (n, 4), np.int32), self._buffer("near", (n,), np.float32)
        view = view_vector(camera)
        with thread_count(self.threads):
            project(
                arrays.means, arrays.quats, arrays.scales, arrays.opacities, arrays.sh0, arrays.shN, degree, view,
                width, height, antialiased, self.settings.alpha_min, shape, extent, box, near,
                self._buffer("radii", (n,), np.float32), self._buffer("ignored", (-(-n // BLOCK),), np.int64),
            )  # fmt: skip
            order = self._depth_order(near)
            starts, _ = self._sort_into_tiles(order, near, extent, box, tiles_x, tiles_x * tiles_y)
            # In the order of the scene, not of depth: what is read and written per splat then lies in a row.
            rows = np.flatnonzero(near > 0.0).astype(np.int32)
            harmonics = np.empty((len(rows), (degree + 1) ** 2 if basis else 0), np.float32)
            basis_of_view(arrays.means, rows, view, degree, harmonics)
        offsets, place = self._buffers["offsets"], self._buffer("place", (n,), np.int32)
        place[rows] = np.arange(len(rows), dtype=np.int32)
        drawn = np.take(shape, rows, axis=0)
        np.minimum(drawn[:, 6:9], _BRIGHTEST, out=drawn[:, 6:9])
        drawn[:, 9] = np.log2(self.settings.alpha_min / drawn[:, 5]) - _MARGIN
        return DrawnView(
            rows=rows,
            shape=drawn,
            box=np.take(box, rows, axis=0),
            basis=harmonics,
            starts=starts.copy(),
            ids=np.take(place, self._buffers["ids"]),
            slots=self._buffers["slots"].copy(),
            first=np.append(offsets[rows], offsets[-1]),  # splats that are not drawn have no records
            width=width,
            height=height,
        )

    def removal(
        self,
        drawn: DrawnView,
        shN: Array,
        totals: Array,
        bands: Array,
        *,
        background: Array,
        reference: Array | None = None,
    ) -> Array:
        """Add one view's sums for every splat to the totals of a scene.

        Args:
            drawn: the view, its shape holding the splats' colours.
            shN: [N, K, 3] float32, spherical harmonics of all splats beyond the first.
            totals: [N, 5] float64, added to: squared change of the picture if the splat were not there, product of
                that change with (picture − reference), weight, squared weight, and 1 if the splat was seen.
            bands: [N, d] float64, added to: squared change of the picture if its band 1, … d were zero; [N, 0] for
                views without a basis.
            background: [3], behind everything.
            reference: [H, W, 3], the image to compare with; None for this render.

        Returns:
            [H, W, 3], the picture.
        """
        rgb, records = self._removal(drawn, background, reference)
        with thread_count(self.threads):
            add_removal(drawn.rows, drawn.first, records, drawn.basis, shN, totals, bands)
        return rgb

    def colours(
        self,
        drawn: DrawnView,
        coefficients: Array,
        active: Array,
        gradient: Array,
        diagonal: Array,
        *,
        offset: float,
        background: Array,
        reference: Array | None = None,
    ) -> Array:
        """Render with other colours, subtract a picture, and take the difference back to the colours.

        A colour is offset + Σ_k Y_k(direction) · coefficient_k if it is active, else 0: linear, not clamped.

        Args:
            drawn: the view; its colours are overwritten.
            coefficients: [N, B, 3] float32.
            active: [V, 3] bool, which colours take part.
            gradient: [N, B, 3] float32, added to: sum over pixels of w · Y_k · (picture − reference).
            diagonal: [N, B] float32, added to: sum over pixels of (w · Y_k)²; empty if it is not needed.
            offset: ½ for pictures of splats, 0 for differences of such pictures.
            background: [3].
            reference: [H, W, 3]; None for black.

        Returns:
            [H, W, 3], the picture, before the subtraction.
        """
        with thread_count(self.threads):
            set_colours(drawn.rows, drawn.basis, coefficients, active, offset, drawn.shape)
        rgb, records = self._colours(drawn, background, reference)
        with thread_count(self.threads):
            add_gradient(drawn.rows, drawn.first, records, drawn.basis, active, gradient, diagonal)
        return rgb

    def trimmed(self, drawn: DrawnView) -> tuple[DrawnView, Array]:
        """Leave out what the last `colours`, of this view, found without any weight: pictures stay the same to the bit.

        Returns:
            The view, and which of the V splats are left.
        """
        return drawn.with_records(self._buffer("sums", (len(drawn.ids), COLOUR_SUMS), self.dtype)[:, 3] > 0.0)

    def _removal(self, drawn: DrawnView, background: Array, reference: Array | None) -> tuple[Array, Array]:
        """Run the loops over pixels, front to back and again back to front: the picture, and the records."""
        size, tiles_x = (drawn.height, drawn.width), -(-drawn.width // TILE)
        records = self._buffer("sums", (len(drawn.ids), SUMS), self.dtype)
        transmittance, last = self._buffer("through", size, self.dtype), self._buffer("last", size, self.dtype)
        rgb = np.empty((*size, 3), self.dtype)
        behind = np.ascontiguousarray(background, self.dtype)
        with thread_count(self.threads):
            blend_counted(
                drawn.starts, drawn.ids, drawn.shape, drawn.box, tiles_x, self._limits, behind,
                rgb, transmittance, last, self._buffer("used", (len(drawn.starts) - 1,), np.int64),
                np.empty((0, 0, 5), self.dtype),
            )  # fmt: skip
            error = np.empty((0, 0, 3), self.dtype) if reference is None else rgb - reference
            sum_removal(
                drawn.starts, drawn.ids, drawn.slots, drawn.shape, drawn.box, tiles_x, self._limits, behind,
                error.astype(self.dtype, copy=False), transmittance, last, records,
            )  # fmt: skip
        return rgb, records

    def _colours(self, drawn: DrawnView, background: Array, reference: Array | None) -> tuple[Array, Array]:
        """Run the loops over pixels, front to back twice: the picture, and the records."""
        size, tiles_x = (drawn.height, drawn.width), -(-drawn.width // TILE)
        records = self._buffer("sums", (len(drawn.ids), COLOUR_SUMS), self.dtype)
        used = self._buffer("used", (len(drawn.starts) - 1,), np.int64)
        rgb = np.empty((*size, 3), self.dtype)
        with thread_count(self.threads):
            blend(
                drawn.starts, drawn.ids, drawn.shape, drawn.box, tiles_x, self._limits,
                np.ascontiguousarray(background, self.dtype), rgb, self._buffer("through", size, self.dtype),
                self._buffer("depth", size, self.dtype), used, np.empty((0, 0, 5), self.dtype),
            )  # fmt: skip
            error = rgb if reference is None else rgb - reference
            sum_colours(
                drawn.starts, used, drawn.ids, drawn.slots, drawn.shape, drawn.box, tiles_x, self._limits,
                error.astype(self.dtype, copy=False), records,
            )  # fmt: skip
        return rgb, records
