"""Authoring of the vectors: `python -m csplat_authoring` writes them, the manifest, and annexes A and C of the spec.

Every byte is written here (`builder`) and every expected number computed here (`reference`): neither our
encoder nor our decoder has a part in them. In a checkout only, not in the wheel.
"""
