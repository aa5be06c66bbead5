"""Overrides of a scene's metadata, which a file may lack."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from csplat.model import SplatModel
from csplat.scene import Scene
from csplat.upright import Direction, with_up


@dataclass(frozen=True)
class SceneOverrides:
    """Overrides of a scene's metadata, which a PLY may lack; `None` keeps the file's own.

    Attributes:
        coordinate_system, unit_metres, antialiased: as in `SplatModel`.
        licence: text for the metadata.
        up: the direction that is up, see `with_up`.
    """

    coordinate_system: str | None = None
    unit_metres: float | None = None
    antialiased: bool | None = None
    licence: str | None = None
    up: Direction | None = None

    def applied(self, model: SplatModel) -> SplatModel:
        """Return the model with these overrides."""
        changes: dict[str, Any] = {
            name: value for name in ("unit_metres", "antialiased") if (value := getattr(self, name)) is not None
        }
        if self.licence is not None:
            changes["metadata"] = {**model.metadata, "licence": self.licence}
        model = replace(model, **changes) if changes else model
        return with_up(model, self.up, self.coordinate_system)

    def applied_to_all(self, scene: Scene) -> Scene:
        """Return the scene with these overrides."""
        return replace(scene, facts=self.applied(scene.facts), blocks=lambda: map(self.applied, scene.blocks()))
