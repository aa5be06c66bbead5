"""Scenes as they lie in files of formats of fixed axes, for their tests: `csplat.read` turns them."""

from csplat.disk_files import local_file
from csplat.formats import detect_format


def filed(file):
    """A scene along the axes of its file."""
    with local_file(file) as path, detect_format(path).open(path) as scene:
        return scene.model()
