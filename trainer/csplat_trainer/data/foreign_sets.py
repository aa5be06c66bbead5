# SPDX-License-Identifier: Apache-2.0
"""Recognise data sets of programs whose files are not read, so that the message names the program and the way out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from csplat.system import open_regular

_HEAD_SIZE = 1 << 12  # bytes that are searched for a mark
_EXPORT = "export the cameras as COLMAP"
_COMPUTE = "compute the poses of its images with COLMAP"
_NERFSTUDIO = "convert it with `ns-process-data {}` of nerfstudio"


@dataclass(frozen=True)
class ForeignSet:
    """A layout of another program.

    Attributes:
        title: the program and its files, in prose.
        patterns: paths in the folder of the set, at least one of which exists. The last part is also the name of a file
            that users pass as the set. Case does not matter.
        remedy: advice that follows "<path> is <title>, which is not read: "; for folders "<path> holds <file>, …".
        mark: bytes near the beginning of such a file, in lower case; b"": the name suffices.
    """

    title: str
    patterns: tuple[str, ...]
    remedy: str
    mark: bytes = b""


FOREIGN_SETS = (
    ForeignSet(
        "a raw export of Polycam",
        ("keyframes/corrected_cameras", "keyframes/cameras", "corrected_cameras"),
        _NERFSTUDIO.format("polycam"),
    ),
    ForeignSet("a capture of Record3D", ("*.r3d", "EXR_RGBD", "rgbd"), _NERFSTUDIO.format("record3d")),
    ForeignSet("a project of Metashape", ("*.psx", "*.psz"), f"{_EXPORT} (File, Export, Export Cameras)"),
    ForeignSet(
        "a camera file of Metashape",
        ("*.xml", "*/*.xml"),
        f"{_EXPORT} instead, or {_NERFSTUDIO.format('metashape')}",
        b"<document",
    ),
    ForeignSet(
        "a project of RealityScan (RealityCapture)", ("*.rcproj", "*.rsproj"), f"{_EXPORT} (Export, Registration)"
    ),
    ForeignSet(
        "a camera list of RealityScan (RealityCapture)",
        ("*.csv", "*/*.csv"),
        f"{_EXPORT} instead, or {_NERFSTUDIO.format('realitycapture')}",
        b"#name,",
    ),
    ForeignSet(
        "images with XMP files of RealityScan (RealityCapture)",
        ("*.xmp", "*/*.xmp"),
        f"{_EXPORT} instead (Export, Registration)",
        b"xcr:",
    ),
    ForeignSet(
        "a scene of OpenMVG",
        ("sfm_data*.json", "sfm_data*.bin", "*/sfm_data*.json", "*/sfm_data*.bin"),
        "convert it with openMVG_main_openMVG2Colmap",
    ),
    ForeignSet(
        "a scene of Meshroom", ("*.sfm", "cameras.abc", "sfm.abc", "*/*.sfm", "*/sfm.abc", "MeshroomCache"), _EXPORT
    ),
    ForeignSet(
        "a reconstruction of OpenDroneMap or OpenSfM",
        ("opensfm/reconstruction.json", "reconstruction.json", "odm_report"),
        f"convert it with `opensfm export_colmap`, or {_NERFSTUDIO.format('odm')}",
    ),
    ForeignSet("a file of Bundler", ("bundle*.out", "*/bundle*.out"), f"convert it to COLMAP, or {_COMPUTE}"),
    ForeignSet("a file of VisualSFM", ("*.nvm", "*/*.nvm"), f"convert it to COLMAP, or {_COMPUTE}"),
    ForeignSet(
        "a project of Pix4D",
        ("*.p4d", "*_calibrated_camera_parameters.txt", "*/params/*_calibrated_camera_parameters.txt"),
        f"{_EXPORT}, or {_COMPUTE}",
    ),
    ForeignSet("a project of Postshot", ("*.psht",), "name the folder of its images and poses"),
    ForeignSet(
        "a capture of Stray Scanner", ("odometry.csv", "*/odometry.csv"), f"take frames of its video, and {_COMPUTE}"
    ),
    ForeignSet(
        "an ARKit capture",
        ("*.traj", "ARPoses.txt", "SyncedPoses.txt"),
        f"convert it to transforms.json, or {_COMPUTE}",
    ),
    ForeignSet("a set of LLFF", ("poses_bounds.npy",), "convert it with llff2nerf.py of torch-ngp"),
    ForeignSet("a set of NeuS", ("cameras_sphere.npz", "cameras*.npz"), "convert it to transforms.json"),
    ForeignSet("a set of MVSNet", ("cams/*_cam.txt", "pair.txt"), f"convert it to transforms.json, or {_COMPUTE}"),
    ForeignSet("a set of Nerfies", ("camera-paths",), "convert it to transforms.json"),
    ForeignSet("a set of NSVF", ("bbox.txt",), "convert it to transforms.json"),
    ForeignSet(
        "a trained scene of 3DGS", ("cfg_args",), "name the data set that it was trained on (source_path in cfg_args)"
    ),
    ForeignSet("a trained scene of nerfstudio", ("nerfstudio_models",), "name the data set that it was trained on"),
    ForeignSet("a point cloud", ("*.las", "*.laz", "*.e57"), "training needs images with poses"),
    ForeignSet("a video", ("*.mp4", "*.mov", "*.insv"), f"take frames of it, and {_COMPUTE}"),
)


def describe_foreign(path: Path) -> str:
    """Return the program of a folder or file, and the way out, or "".

    Args:
        path: a folder that is not a data set, or a file.
    """
    for foreign_set in FOREIGN_SETS:
        if path.is_dir():
            files = [file for pattern in foreign_set.patterns for file in path.glob(_any_case(pattern))]
        else:
            names = {pattern.rpartition("/")[2] for pattern in foreign_set.patterns}
            files = [path] if any(path.match(_any_case(name)) for name in names) else []
        file = next((file for file in files if _has_mark(file, foreign_set.mark)), None)
        if file is not None:
            subject = f"{path} holds {file.relative_to(path).as_posix()}," if path.is_dir() else f"{path} is"
            return f"{subject} {foreign_set.title}, which is not read: {foreign_set.remedy}"
    return ""


def _any_case(pattern: str) -> str:
    """Return a glob pattern that matches letters in any case."""
    return "".join(f"[{letter.lower()}{letter.upper()}]" if letter.isalpha() else letter for letter in pattern)


def _has_mark(path: Path, mark: bytes) -> bool:
    """Return True if the beginning of a file has a mark, in any case; for an empty mark, without reading it."""
    if not mark:
        return True
    try:
        with open_regular(path) as stream:
            return mark in stream.read(_HEAD_SIZE).lower()
    except OSError:
        return False
