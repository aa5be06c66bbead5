# SPDX-License-Identifier: Apache-2.0
"""Models with metadata, for tests."""

from dataclasses import fields, replace

from csplat.model import SplatModel
from csplat.scene_metadata import SceneMetadata

_FACTS = [one.name for one in fields(SceneMetadata)]


def model_of(**values):
    """Return a model from fields of `SplatModel` and of its `SceneMetadata`."""
    facts = {name: values.pop(name) for name in _FACTS if name in values}
    metadata = replace(values.pop("metadata", SceneMetadata()), **facts)
    return SplatModel(**values, metadata=metadata)


def with_facts(model, **facts):
    """Return a model with other fields of its `SceneMetadata`."""
    return model.with_metadata(replace(model.metadata, **facts))
